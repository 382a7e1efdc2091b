// Tile binning on CPUs: a stable counting sort of the depth-sorted splats, with the tiles as bins.
// Index space of both kernels: one work-item per block of the depth-sorted splats of each view, which has `count` entries.

// Windows are prefetched, since the depth order scatters them in memory.
#define PREFETCH_DISTANCE 16

typedef struct {
    int tiles_x, tiles_y, width, height;
    uint from, to;           // this block
    global uint *row;        // row of table[SORT_BLOCKS][tiles]
} SortBlock;

static inline SortBlock sort_block_of(uint length, int width, int height, global uint *restrict table) {
    SortBlock c;
    uint block = get_global_id(0), block_size = (length + SORT_BLOCKS - 1) / SORT_BLOCKS;
    c.width = width;
    c.height = height;
    c.tiles_x = (width + TILE_W - 1) / TILE_W;
    c.tiles_y = (height + TILE_H - 1) / TILE_H;
    c.from = min(block * block_size, length);
    c.to = min(c.from + block_size, length);
    c.row = table + ((size_t)get_global_id(1) * SORT_BLOCKS + block) * c.tiles_x * c.tiles_y;
    return c;
}

typedef struct {             // state of bin_emit: tiles [first, end); base: start of its first list
    int first, end;
    uint base;
    global const uint *starts;
    global uint *lists;
} Emission;

// Counts a tile of a splat or, with an emission, writes the splat to the tile's list: one function for both, so they agree.
static inline void bin_tile(int tile, uint index, const SortBlock *c, const Emission *e) {
    if (e) {
        if (tile < e->first || tile >= e->end) return;
        // differences modulo 2^32 are correct within the range of tiles, even if the frame has more pairs
        uint position = e->starts[tile] - e->base + c->row[tile];
        e->lists[position] = index;
    }
    c->row[tile]++;
}

static inline void bin_splats(global const uint *restrict order, global const uint2 *restrict windows,
                              uint big_capacity, global const Bounds *restrict big_bounds, const SortBlock *c,
                              const Emission *e) {
    for (uint k = c->from; k < c->to; k++) {
        PREFETCH(windows + order[min(k + PREFETCH_DISTANCE, c->to - 1)]);
        uint index = order[k];
        uint2 window = windows[index];
        if (window.y == 0 && window.x < big_capacity) {
            Bounds b = big_bounds[window.x];
            int y0, y1;
            bounds_rows(&b, c->height, &y0, &y1);
            for (int ty = y0 / TILE_H; ty * TILE_H < y1; ty++) {
                TileSpan span = tile_span(&b, ty, c->width, c->height);
                for (int tx = span.first; tx <= span.last; tx++) bin_tile(ty * c->tiles_x + tx, index, c, e);
            }
        }
        for (; window.y != 0; window.y &= window.y - 1) bin_tile(window_tile(window, c->tiles_x), index, c, e);
    }
}

// Reads: order, counters[COUNTER_VISIBLE], windows, big_bounds. Writes: this block's row of table.
kernel void bin_count(
//@@ arguments bin_count
) {
    if (get_global_id(0) >= SORT_BLOCKS) return;
    const SortBlock c = sort_block_of(counters[get_global_id(1) * COUNTERS + COUNTER_VISIBLE], width, height, table);
    order += get_global_id(1) * count;
    for (int tile = 0; tile < c.tiles_x * c.tiles_y; tile++) c.row[tile] = 0;
    bin_splats(order, windows, big_capacity, big_bounds, &c, 0);
}

// Reads: the inputs of bin_count, and starts. Reads and overwrites: table, of the tiles [first_tile, end_tile). Writes: lists.
kernel void bin_emit(
//@@ arguments bin_emit
) {
    if (get_global_id(0) >= SORT_BLOCKS) return;
    const SortBlock c = sort_block_of(counters[get_global_id(1) * COUNTERS + COUNTER_VISIBLE], width, height, table);
    order += get_global_id(1) * count;
    int before = (int)get_global_id(1) * c.tiles_x * c.tiles_y;    // tiles of preceding views
    const Emission e = {first_tile - before, end_tile - before, starts[first_tile], starts + before, lists};
    bin_splats(order, windows, big_capacity, big_bounds, &c, &e);
}
