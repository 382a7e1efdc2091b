// Tile binning and sorting on GPUs: prefix sum of the tile counts, pairs of (depth key, splat) written to each tile's list in
// any order, then a sort per list. Keys are unique (ties are broken by splat index), so the sorted lists are deterministic.
// Tiles of a batch are numbered view after view.

// Exclusive prefix sum of `mine` over a work-group of SCAN_ITEMS; *total is the sum. partial: scratch of SCAN_ITEMS values.
static inline ulong scan_group(local ulong *partial, uint item, ulong mine, ulong *total) {
    partial[item] = mine;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint step = 1; step < SCAN_ITEMS; step *= 2) {
        ulong before = item >= step ? partial[item - step] : 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        partial[item] += before;
        barrier(CLK_LOCAL_MEM_FENCE);
    }
    *total = partial[SCAN_ITEMS - 1];
    ulong exclusive = partial[item] - mine;
    barrier(CLK_LOCAL_MEM_FENCE);
    return exclusive;
}

// Indices in the buffer `counts`, which the host reads: numbers of big splats, of pairs (64 bits), of visible splats.
enum { COUNT_BIG = 0, COUNT_PAIRS = 1, COUNT_VISIBLE = 3 };

// Index space: one work-group of SCAN_ITEMS.
// Reads: tallies, zeroed for the next frame if `clear`. Writes: starts[tiles + 1] modulo 2^32, cursors[tiles] (the same), counts;
// `emit` adds the number of visible splats.
// All lists are empty if there are more pairs than `capacity`, unless that is 2^32 - 1.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void tile_starts(
//@@ arguments tile_starts
) {
    local ulong partial[SCAN_ITEMS];
    uint item = get_local_id(0);
    ulong running = 0;
    for (uint first = 0; first < tiles; first += 4 * SCAN_ITEMS) {
        uint from = min(first + 4 * item, tiles), to = min(from + 4, tiles);
        ulong mine = 0, total;
        for (uint tile = from; tile < to; tile++) mine += tallies[TALLIES + tile];
        ulong place = running + scan_group(partial, item, mine, &total);
        for (uint tile = from; tile < to; tile++) {
            starts[tile] = cursors[tile] = (uint)place;
            place += tallies[TALLIES + tile];
            if (clear) tallies[TALLIES + tile] = 0;
        }
        running += total;
    }
    if (item == 0) {
        starts[tiles] = (uint)running;
        counts[COUNT_BIG] = tallies[TALLY_BIG];
        if (clear) tallies[TALLY_BIG] = 0;
        counts[COUNT_VISIBLE] = 0;   // added up by `emit`
        counts[COUNT_PAIRS] = (uint)running;
        counts[COUNT_PAIRS + 1] = (uint)(running >> 32);
    }
    if (capacity != 0xFFFFFFFFu && running > capacity) {
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (uint tile = item; tile <= tiles; tile += SCAN_ITEMS) starts[tile] = 0;
    }
}

// Work-items of a group of the per-splat kernels. A splat that overlaps more tiles than a window is shared by a complete group.
#define BIN_ITEMS 256

// Rectangle of tiles that a big splat may overlap. Counting and listing both call this, so they agree, and `tile_count`
// (moments.cl), which numbers the gradient buffer offsets, agrees with both.
typedef struct { int top, left, columns, cells, tiles_x; } TileRect;

static inline TileRect tile_rect(const Bounds *b, int width, int height) {
    int y0, y1;
    float x0, x1;
    bounds_rows(b, height, &y0, &y1);
    bounds_span(b, -INFINITY, INFINITY, &x0, &x1);
    // rounding may widen a row's chord, but never beyond this: tile_span returns no tile outside of the rectangle
    x0 = fmin(x0, b->ex - b->hx);
    x1 = fmax(x1, b->ex + b->hx);
    int first = clamp(pixel_above(x0 - 0.5f, width), 0, width - 1), last = clamp(pixel_below(x1 - 0.5f, width), first, width - 1);
    TileRect rect = {y0 / TILE_H, first / TILE_W, last / TILE_W - first / TILE_W + 1, 0, (width + TILE_W - 1) / TILE_W};
    rect.cells = ((y1 - 1) / TILE_H - rect.top + 1) * rect.columns;
    return rect;
}

// Number of tiles of a view.
static inline int tiles_of(int width, int height) {
    return ((width + TILE_W - 1) / TILE_W) * ((height + TILE_H - 1) / TILE_H);
}

// Tile of a cell of the rectangle; -1 if the splat does not overlap it.
static inline int rect_tile(const TileRect *rect, int cell, const Bounds *b, int width, int height) {
    int row = rect->top + cell / rect->columns, column = rect->left + cell % rect->columns;
    TileSpan span = tile_span(b, row, width, height);
    return column >= span.first && column <= span.last ? row * rect->tiles_x + column : -1;
}

// Adds the tiles of big splats to the tallies.
// Index space: any number of work-groups; each processes every n-th splat.
// Reads: tallies' number of big splats, big, big_bounds.
kernel __attribute__((reqd_work_group_size(BIN_ITEMS, 1, 1))) void tally_big(
//@@ arguments tally_big
) {
    uint big_count = min(tallies[TALLY_BIG], big_capacity);
    for (uint k = get_group_id(0); k < big_count; k += get_num_groups(0)) {
        const Bounds b = big_bounds[k];
        const TileRect rect = tile_rect(&b, width, height);
        int before = (int)(big[k] / count) * tiles_of(width, height);
        for (int cell = get_local_id(0); cell < rect.cells; cell += BIN_ITEMS) {
            int tile = rect_tile(&rect, cell, &b, width, height);
            if (tile >= 0) atomic_inc(tallies + TALLIES + before + tile);
        }
    }
}

#define NO_OFFSET 0xFFFFFFFFu
#define NO_ENTRY 0xFFFFFFFFu
#define WINDOW_TILES (WINDOW_W * WINDOW_H)
#define UNROLL 4                // atomics in flight per work-item

// Lists of the tiles of a band [band_first, band_end), at most `capacity` pairs.
typedef struct {
    int tiles_x, first, end;
    uint start, capacity;
} Band;

// Next free index of a tile's list, or NO_OFFSET outside of the band. Modulo 2^32: indices within the band are right even if the
// frame has more pairs than that.
static inline uint next_offset(int tile, const Band *band, global uint *restrict cursors) {
    return tile < band->first || tile >= band->end ? NO_OFFSET : atomic_inc(cursors + tile) - band->start;
}

// Writes the (splat, key) pairs of all tiles of a band.
// Index space: for each view `splat_groups` work-groups, one work-item per splat, then the same number of work-groups for every
// view, which share the big splats.
// Reads: windows, keys, starts, big, big_bounds. Consumes: cursors of the band. Writes: pairs; adds to counts' number of visible
// splats.
kernel __attribute__((reqd_work_group_size(BIN_ITEMS, 1, 1))) void emit(
//@@ arguments emit
) {
    local uint visible, queued;
    local ushort queue[BIN_ITEMS * WINDOW_TILES];     // (work-item of the splat, tile of its window)
    local uint corners[BIN_ITEMS], depths[BIN_ITEMS];
    const Band band = {(width + TILE_W - 1) / TILE_W, band_first, band_end, starts[band_first], capacity};
    uint item = get_local_id(0), number = get_group_id(1), big_count = min(counts[COUNT_BIG], big_capacity);
    if (item == 0) visible = queued = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    if (get_group_id(0) >= splat_groups) {
        uint groups = get_num_groups(0) - splat_groups;
        for (uint k = number * groups + get_group_id(0) - splat_groups; k < big_count; k += groups * get_num_groups(1)) {
            const Bounds b = big_bounds[k];
            const TileRect rect = tile_rect(&b, width, height);
            uint splat = big[k], key = keys[splat];
            int before = (int)(splat / count) * tiles_of(width, height);
            for (int cell = item; cell < rect.cells; cell += BIN_ITEMS) {
                int tile = rect_tile(&rect, cell, &b, width, height);
                uint place = tile < 0 ? NO_OFFSET : next_offset(before + tile, &band, cursors);
                if (place < band.capacity) pairs[place] = (uint2)(splat, key);
            }
        }
    } else {
        uint i = get_global_id(0), splat = number * count + i;
        uint key = i < count ? keys[splat] : CULLED;
        if (key != CULLED) {
            if (first_band) atomic_inc(&visible);
            uint2 window = windows[splat];
            corners[item] = window.x;
            depths[item] = key;
            for (uint at = window.y != 0 ? atomic_add(&queued, popcount(window.y)) : 0; window.y != 0; window.y &= window.y - 1)
                queue[at++] = (ushort)(item * WINDOW_TILES + 31 - clz(window.y & -window.y));
        }
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    // evenly shared, since splats overlap few or many tiles; several at once, since each atomic has latency
    int before = (int)number * tiles_of(width, height);
    uint first_splat = number * count + (uint)get_global_id(0) - item;
    for (uint from = item; from < queued; from += UNROLL * BIN_ITEMS) {
        uint places[UNROLL], owners[UNROLL];
        for (uint n = 0; n < UNROLL; n++) {
            uint entry = from + n * BIN_ITEMS < queued ? queue[from + n * BIN_ITEMS] : NO_ENTRY;
            owners[n] = entry / WINDOW_TILES;
            places[n] = NO_OFFSET;
            if (entry != NO_ENTRY) {
                uint2 one = (uint2)(corners[owners[n]], 1u << entry % WINDOW_TILES);
                places[n] = next_offset(before + window_tile(one, band.tiles_x), &band, cursors);
            }
        }
        for (uint n = 0; n < UNROLL; n++)
            if (places[n] < band.capacity) pairs[places[n]] = (uint2)(first_splat + owners[n], depths[owners[n]]);
    }
    if (item == 0 && visible != 0) atomic_add(counts + COUNT_VISIBLE, visible);
}

// Sorts each tile's list by (depth key, splat); all keys differ.
// Index space: work-groups of SORT_ITEMS, one per tile of the band.
// Reads: starts. Consumes: pairs. Writes: lists.
//
// A list that fits local memory is bucket-sorted by depth. Short and long lists, and those with an overfull bucket, go through a
// bitonic network; every comparator moves the smaller key to the front, as if the list were padded with infinities.
#define SORT_ITEMS 256
#define SORT_LOCAL 2048          // pairs sorted in local memory
#define SHORT 64                 // pairs for which the network is faster
#define BUCKETS 1024              // buckets of the depth range
#define BUCKET_LIMIT 128              // pairs of one bucket: larger ones are not sorted by comparing all pairs
#define ROW 16                   // work-items whose sums are added serially; SORT_ITEMS is its square
enum { ITEM_PAIRS = SORT_LOCAL / SORT_ITEMS, ITEM_BUCKETS = BUCKETS / SORT_ITEMS };   // per work-item

// Indices i < j of comparator t of a step with partners `stride` (a power of two) apart; in the first step of a block of
// 2 * stride elements (`mirrored`) partners are mirror images.
static inline void comparator(uint t, uint stride, bool mirrored, uint *i, uint *j) {
    uint inside = t & (stride - 1);
    *i = 2 * t - inside;
    *j = mirrored ? *i + 2 * (stride - inside) - 1 : *i + stride;
}

// One step of the network on `items`; `fence` names their address space.
#define SORT_STEP(items, length, comparators, stride, mirrored, fence)                      \
    for (uint t = get_local_id(0); t < (comparators); t += SORT_ITEMS) {                    \
        uint i, j;                                                                          \
        comparator(t, stride, mirrored, &i, &j);                                            \
        if (j < (length)) {                                                                 \
            ulong a = (items)[i], b = (items)[j];                                           \
            if (a > b) {                                                                    \
                (items)[i] = b;                                                             \
                (items)[j] = a;                                                             \
            }                                                                               \
        }                                                                                   \
    }                                                                                       \
    barrier(fence)

// Depth of a key: the inverse of `sortable`.
static inline float depth_of(uint key) { return as_float((key & 0x80000000u) ? key & 0x7FFFFFFFu : ~key); }

// Bucket of a pair, monotonic in depth. fmax: where all depths are equal, or infinite, the product may be NaN.
static inline uint bucket_of(ulong pair, float nearest, float scale) {
    return (uint)fmin(fmax((depth_of((uint)(pair >> 32)) - nearest) * scale, 0.0f), BUCKETS - 1.0f);
}

typedef struct {             // state of the bucket sort, in local memory
    uint lowest, highest, overfull;    // keys; whether a bucket is
    uint rows[ROW];                   // pairs of each row of work-items
    uint starts[BUCKETS];              // number of pairs of each bucket, then its start
} Buckets;

// Lowest and highest key of `length` pairs. scratch: SORT_ITEMS values.
static inline void find_key_range(global const ulong *pairs, uint length, local uint2 *scratch, local Buckets *buckets) {
    uint item = get_local_id(0), lowest = 0xFFFFFFFFu, highest = 0;
    for (uint k = item; k < length; k += SORT_ITEMS) {
        uint key = (uint)(pairs[k] >> 32);
        lowest = min(lowest, key);
        highest = max(highest, key);
    }
    scratch[item] = (uint2)(lowest, highest);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 2 * ROW) {    // few, since atomics on one address are serialised
        for (uint k = item + 2 * ROW; k < SORT_ITEMS; k += 2 * ROW) {
            lowest = min(lowest, scratch[k].x);
            highest = max(highest, scratch[k].y);
        }
        atomic_min(&buckets->lowest, lowest);
        atomic_max(&buckets->highest, highest);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Turns the bucket counts into bucket starts and detects an overfull bucket. sums: scratch of SORT_ITEMS values.
static inline void bucket_starts(local uint *sums, local Buckets *buckets) {
    uint item = get_local_id(0), numbers[ITEM_BUCKETS], sum = 0, before = 0;
    for (uint n = 0; n < ITEM_BUCKETS; n++) {
        numbers[n] = buckets->starts[item * ITEM_BUCKETS + n];
        if (numbers[n] > BUCKET_LIMIT) buckets->overfull = 1;
        sum += numbers[n];
    }
    sums[item] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item - item % ROW; k < item; k++) before += sums[k];
    if (item % ROW == ROW - 1) buckets->rows[item / ROW] = before + sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint row = 0; row < item / ROW; row++) before += buckets->rows[row];
    for (uint n = 0; n < ITEM_BUCKETS; n++) {
        buckets->starts[item * ITEM_BUCKETS + n] = before;
        before += numbers[n];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Bucket sort of at most SORT_LOCAL pairs into `list`. Within its bucket, a pair's index is the number of smaller keys. Returns
// false, for all work-items, if a bucket is overfull. items: scratch of SORT_LOCAL values.
static inline bool bucket_sort(global const ulong *pairs, uint length, local ulong *items, local Buckets *buckets,
                               global uint *restrict list) {
    uint item = get_local_id(0), places[ITEM_PAIRS];
    if (item == 0) {
        buckets->lowest = 0xFFFFFFFFu;
        buckets->highest = buckets->overfull = 0;
    }
    for (uint k = item; k < BUCKETS; k += SORT_ITEMS) buckets->starts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    find_key_range(pairs, length, (local uint2 *)items, buckets);
    float nearest = depth_of(buckets->lowest), scale = BUCKETS / (depth_of(buckets->highest) - nearest);
    for (uint n = 0; n < ITEM_PAIRS; n++) {
        uint k = item + n * SORT_ITEMS;
        if (k < length) places[n] = atomic_inc(buckets->starts + bucket_of(pairs[k], nearest, scale));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    bucket_starts((local uint *)items, buckets);
    if (buckets->overfull) return false;
    for (uint n = 0; n < ITEM_PAIRS; n++) {
        uint k = item + n * SORT_ITEMS;
        if (k < length) items[buckets->starts[bucket_of(pairs[k], nearest, scale)] + places[n]] = pairs[k];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (uint k = item; k < length; k += SORT_ITEMS) {
        ulong pair = items[k];
        uint range = bucket_of(pair, nearest, scale), start = buckets->starts[range], place = start;
        uint end = range + 1 < BUCKETS ? buckets->starts[range + 1] : length;
        for (uint other = start; other < end; other++) place += items[other] < pair;
        list[place] = (uint)pair;
    }
    return true;
}

kernel __attribute__((reqd_work_group_size(SORT_ITEMS, 1, 1))) void sort_tiles(
//@@ arguments sort_tiles
) {
    local ulong items[SORT_LOCAL];
    local Buckets buckets;
    uint tile = band_first + get_group_id(0), item = get_local_id(0);
    uint start = starts[tile] - starts[band_first], length = starts[tile + 1] - starts[tile];
    global ulong *list = pairs + start;
    if (length > SHORT && length <= SORT_LOCAL && bucket_sort(list, length, items, &buckets, lists + start)) return;
    uint padded = 1;
    while (padded < length) padded *= 2;

    // blocks that fit local memory: all of a short list
    uint block = min(padded, (uint)SORT_LOCAL);
    for (uint size = block; size <= padded; size *= 2) {
        bool all_stages = size == block;   // all stages of each block; afterwards the stages that a wider stage leaves within the blocks
        for (uint stride = size / 2; stride >= SORT_LOCAL; stride /= 2) {
            SORT_STEP(list, length, padded / 2, stride, stride == size / 2, CLK_GLOBAL_MEM_FENCE);
        }
        for (uint from = 0; from < length; from += block) {
            uint here = min(length - from, block);
            for (uint k = item; k < here; k += SORT_ITEMS) items[k] = list[from + k];
            barrier(CLK_LOCAL_MEM_FENCE);
            for (uint stage = all_stages ? 2 : block; stage <= block; stage *= 2)
                for (uint stride = stage / 2; stride > 0; stride /= 2) {
                    SORT_STEP(items, here, block / 2, stride, all_stages && stride == stage / 2, CLK_LOCAL_MEM_FENCE);
                }
            for (uint k = item; k < here; k += SORT_ITEMS) {
                if (size == padded) lists[start + from + k] = (uint)items[k];
                else list[from + k] = items[k];
            }
            barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
        }
    }
}
