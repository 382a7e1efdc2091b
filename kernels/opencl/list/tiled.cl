// For GPUs: project counts the splat's tiles at once and keeps which they are in 64 bits; tiles.cl lists them per tile in
// any order and sorts each list. The counters are integers, so their sums do not depend on the order of the additions,
// and the sort's keys are all different, so the lists do not either. The sections below stand in project.cl.
//@ list_functions
#define WINDOW_W 8
#define WINDOW_H 4

// Which tiles the bounds can touch, as bits of a window of WINDOW_W x WINDOW_H tiles whose corner is (*x, *y); 0 if they
// reach beyond one. Columns [x0, x1) and rows [y0, y1) enclose them.
static inline uint tile_window(const Bounds *b, int x0, int x1, int y0, int y1, int width, int height, int *x, int *y) {
    int left = x0 / TILE_W, columns = (x1 - 1) / TILE_W - left + 1;
    int top = y0 / TILE_H, rows = (y1 - 1) / TILE_H - top + 1;
    *x = left;
    *y = top;
    if (rows > WINDOW_H || columns > WINDOW_W) return 0;
    if (rows == 1) return (1u << columns) - 1u;
    if (columns == 1) return 0x01010101u >> (WINDOW_W * (WINDOW_H - rows));
    uint mask = 0;
    for (int row = 0; row < rows; row++) {
        TileSpan span = tile_span(b, top + row, width, height);
        // a chord between two rows of pixels may be wider than those at the rows
        int first = max(span.first - left, 0), last = min(span.last - left, columns - 1);
        if (first <= last) mask |= ((2u << (last - first)) - 1u) << first << (row * WINDOW_W);
    }
    return mask;
}
//@ list_args
    , global uint2 *restrict windows          // (n): corner (x, y in 16 bits each) and bits
    , global uint *restrict tallies           // counts, then tiles
    , uint big_capacity
    , global uint *restrict big               // splats that touch more than a window
    , global Bounds *restrict big_bounds
//@ list_culled
    windows[i] = (uint2)(0, 0);
//@ list
    int corner_x, corner_y;
    uint window = tile_window(&bounds, record.x0, record.x1, y0, y1, width, height, &corner_x, &corner_y);
    windows[i] = (uint2)((uint)corner_x | (uint)corner_y << 16, window);
    if (window == 0) {
        uint place = atomic_inc(tallies + TALLY_BIG);
        if (place < big_capacity) {
            big[place] = i;
            big_bounds[place] = bounds;
        }
    }
    int tiles_x = (width + TILE_W - 1) / TILE_W;
    for (; window != 0; window &= window - 1) {
        int bit = 31 - clz(window & -window);
        atomic_inc(tallies + TALLIES + (corner_y + bit / WINDOW_W) * tiles_x + corner_x + bit % WINDOW_W);
    }
