// For CPUs: what a splat can touch of a tile. Blocks are BLOCK_W x BLOCK_H pixels, of which a small splat fills more than of a row;
// they are numbered row by row.
#define BLOCK_H (LANES / BLOCK_W)
#define BLOCKS_X (TILE_W / BLOCK_W)
#define BLOCKS (TILE_H / BLOCK_H * BLOCKS_X)          // 32 at most
#define LEFT(block) ((int)((uint)(block) % BLOCKS_X) * BLOCK_W)    // in the tile
#define TOP(block) ((int)((uint)(block) / BLOCKS_X) * BLOCK_H)
#define LANE_X(block, lane) (LEFT(block) + (lane) % BLOCK_W)
#define LANE_Y(block, lane) (TOP(block) + (lane) / BLOCK_W)

// A condition that hardly ever holds. So compilers branch, and the processor goes on with the next splat meanwhile: what they would
// select instead, it could not go on without.
#ifdef __has_builtin
#if __has_builtin(__builtin_expect)
#define RARELY(condition) __builtin_expect(condition, 0)
#endif
#endif
#ifndef RARELY
#define RARELY(condition) (condition)
#endif

// A bit for each block whose columns meet [x0, x1) and whose rows meet [y0, y1), of the tile and not empty.
static inline uint blocks_within(int x0, int x1, int y0, int y1) {
    uint columns = (2u << (x1 - 1) / BLOCK_W) - (1u << x0 / BLOCK_W);
    uint rows = (2u << ((y1 - 1) / BLOCK_H * BLOCKS_X + BLOCKS_X - 1)) - (1u << y0 / BLOCK_H * BLOCKS_X);
    return columns * (0xFFFFFFFFu / ((1u << BLOCKS_X) - 1u)) & rows;
}

//@@ blocks_functions
// Which blocks of the tile at (left, top) the splat can touch. Conservative; the test of each pixel decides.
static inline uint touched_blocks(const Splat *s, int left, int top, wide half_r2, wide filter
//@@ blocks_parameters
) {
    int x0 = max(s->x0 - left, 0), x1 = min(s->x1 - left, TILE_W), y0 = max(s->y0 - top, 0), y1 = min(s->y1 - top, TILE_H);
    if (x0 >= x1 || y0 >= y1) return 0;
    uint touched = blocks_within(x0, x1, y0, y1);
//@@ blocks_touched
    return touched;
}
