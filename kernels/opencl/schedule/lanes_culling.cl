// Culling by blocks of a tile, for CPUs. A block is BLOCK_W x BLOCK_H pixels, since a small splat fills more of it than of a row;
// blocks are numbered row by row.
#define BLOCK_H (LANES / BLOCK_W)
#define BLOCKS_X (TILE_W / BLOCK_W)
#define BLOCKS (TILE_H / BLOCK_H * BLOCKS_X)          // at most 32
#define LEFT(block) ((int)((uint)(block) % BLOCKS_X) * BLOCK_W)    // relative to the tile
#define TOP(block) ((int)((uint)(block) / BLOCKS_X) * BLOCK_H)
#define LANE_X(block, lane) (LEFT(block) + (lane) % BLOCK_W)
#define LANE_Y(block, lane) (TOP(block) + (lane) / BLOCK_W)

// Branch hint for a rare condition: compilers then branch and the processor speculates, where a select would stall.
#ifdef __has_builtin
#if __has_builtin(__builtin_expect)
#define UNLIKELY(condition) __builtin_expect(condition, 0)
#endif
#endif
#ifndef UNLIKELY
#define UNLIKELY(condition) (condition)
#endif

// Bits of the blocks that overlap columns [x0, x1) and rows [y0, y1) of the tile.
static inline uint blocks_within(int x0, int x1, int y0, int y1) {
    uint within = 0;
    for (int first = 0; first < BLOCKS; first += LANES) {
        vint x = VINDEX % BLOCKS_X * BLOCK_W, y = (first + VINDEX) / BLOCKS_X * BLOCK_H;
        within |= VBITS(VMASK(x < x1) & VMASK(x > x0 - BLOCK_W) & VMASK(y < y1) & VMASK(y > y0 - BLOCK_H)) << first;
    }
    return within;
}

//@@ blocks_functions
// Blocks of the tile at (left, top) that the splat overlaps. Conservative; the test of each pixel decides.
static inline uint touched_blocks(const Splat *s, int left, int top, blend_real half_r2, blend_real sample_area
//@@ blocks_parameters
) {
    uint touched = blocks_within(s->x0 - left, s->x1 - left, s->y0 - top, s->y1 - top);
    if (touched == 0) return 0;
//@@ blocks_occluded
//@@ blocks_touched
    return touched;
}
