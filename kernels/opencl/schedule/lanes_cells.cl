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
#define UNLIKELY(condition) __builtin_expect(condition, 0)
#endif
#endif
#ifndef UNLIKELY
#define UNLIKELY(condition) (condition)
#endif

// A bit for each block that meets columns [x0, x1) and rows [y0, y1) of the tile.
static inline uint blocks_within(int x0, int x1, int y0, int y1) {
    uint within = 0;
    for (int first = 0; first < BLOCKS; first += LANES) {
        vint x = VINDEX % BLOCKS_X * BLOCK_W, y = (first + VINDEX) / BLOCKS_X * BLOCK_H;
        within |= VBITS(VMASK(x < x1) & VMASK(x > x0 - BLOCK_W) & VMASK(y < y1) & VMASK(y > y0 - BLOCK_H)) << first;
    }
    return within;
}

//@@ blocks_functions
// Which blocks of the tile at (left, top) the splat can touch. Conservative; the test of each pixel decides.
static inline uint touched_blocks(const Splat *s, int left, int top, wide half_r2, wide filter
//@@ blocks_parameters
) {
    uint touched = blocks_within(s->x0 - left, s->x1 - left, s->y0 - top, s->y1 - top);
    if (touched == 0) return 0;
//@@ blocks_touched
    return touched;
}
