// Lists of splats per tile for GPUs: places from the tiles' tallies, pairs of (depth key, splat) written
// there in any order, and a sort of each list. Keys are unique (the splat's index breaks ties), so the sorted lists are
// the same on every run. The tiles of many views stand one view after the other.

// Exclusive prefix sum of `mine` over a work-group of SCAN_ITEMS; *total is the sum of all. partial: SCAN_ITEMS values.
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

// places in the buffer `counts`, which the host reads: numbers of big splats, of pairs (64 bits), of visible splats
enum { COUNT_BIG = 0, COUNT_PAIRS = 1, COUNT_VISIBLE = 3 };

// Index space: one work-group of SCAN_ITEMS.
// Reads: tallies, and zeroes them for the next picture if `clear`. Writes: starts[tiles + 1] modulo 2^32, cursors[tiles]
// (the same), counts, of which the visible splats are still to be added up.
// If there are more pairs than `capacity` (and that is not 2^32 - 1), all lists are made empty.
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
        counts[COUNT_VISIBLE] = 0;   // emit adds them up
        counts[COUNT_PAIRS] = (uint)running;
        counts[COUNT_PAIRS + 1] = (uint)(running >> 32);
    }
    if (capacity != 0xFFFFFFFFu && running > capacity) {
        barrier(CLK_GLOBAL_MEM_FENCE);
        for (uint tile = item; tile <= tiles; tile += SCAN_ITEMS) starts[tile] = 0;
    }
}

// Work-groups of BIN_ITEMS, for what is done splat by splat. Of a splat that touches more than a window a whole group
// shares the tiles.
#define BIN_ITEMS 256

// The rectangle of tiles that a big splat may touch. Counts and lists both come from this, so they agree, also with `tile_count`
// (moments.cl), by which derivatives have their places.
typedef struct { int top, left, columns, cells, tiles_x; } TileRect;

static inline TileRect tile_rect(const Bounds *b, int width, int height) {
    int y0, y1;
    float x0, x1;
    bounds_rows(b, height, &y0, &y1);
    bounds_span(b, -INFINITY, INFINITY, &x0, &x1);
    // a row's chord may be rounded to be wider than the widest, but never beyond these: tile_span gives no tile that is not here
    x0 = fmin(x0, b->ex - b->hx);
    x1 = fmax(x1, b->ex + b->hx);
    int first = clamp(pixel_above(x0 - 0.5f, width), 0, width - 1), last = clamp(pixel_below(x1 - 0.5f, width), first, width - 1);
    TileRect rect = {y0 / TILE_H, first / TILE_W, last / TILE_W - first / TILE_W + 1, 0, (width + TILE_W - 1) / TILE_W};
    rect.cells = ((y1 - 1) / TILE_H - rect.top + 1) * rect.columns;
    return rect;
}

// Tiles of one view.
static inline int tiles_of(int width, int height) {
    return ((width + TILE_W - 1) / TILE_W) * ((height + TILE_H - 1) / TILE_H);
}

// The tile of one cell of these rows; -1 if the splat cannot touch it.
static inline int rect_tile(const TileRect *rect, int cell, const Bounds *b, int width, int height) {
    int row = rect->top + cell / rect->columns, column = rect->left + cell % rect->columns;
    TileSpan span = tile_span(b, row, width, height);
    return column >= span.first && column <= span.last ? row * rect->tiles_x + column : -1;
}

// Adds the tiles of big splats to the tallies.
// Index space: any number of work-groups; each takes every so many-th splat.
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
#define UNROLL 4                // places that a work-item asks for before it waits

// Lists of the tiles of the band [band_first, band_end), from 0; never beyond `capacity`.
typedef struct {
    int tiles_x, first, end;
    uint start, capacity;
} Band;

// The next place in a tile's list, or one beyond all capacity. Modulo 2^32: a place within the band is right even where the picture
// has more pairs than that.
static inline uint next_offset(int tile, const Band *band, global uint *restrict cursors) {
    return tile < band->first || tile >= band->end ? NO_OFFSET : atomic_inc(cursors + tile) - band->start;
}

// Index space: for each view `splat_groups` work-groups, a work-item per splat, and then the same number of work-groups as for
// every other view; these share out the big splats.
// Reads: windows, keys, starts, big, big_bounds. Uses up: cursors of the band. Writes: pairs; adds to counts' number of
// visible splats.
kernel __attribute__((reqd_work_group_size(BIN_ITEMS, 1, 1))) void emit(
//@@ arguments emit
) {
    local uint visible, queued;
    local ushort queue[BIN_ITEMS * WINDOW_TILES];     // of a splat of the group (by its work-item) and a tile of its window
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
    // shared out evenly, since splats touch few tiles or many, and several at once, since each waits for its place
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

// Sorts each list by (depth key, splat), which are all different.
// Index space: work-groups of SORT_ITEMS, one per tile of the band.
// Reads: starts. Uses up: pairs. Writes: lists.
//
// A list that fits local memory is spread over ranges of depth. Where one of them is crowded, and for short and longer lists, there is
// a bitonic network whose every comparison puts the smaller first, so that a list of any length is sorted as if it were followed by
// infinities.
#define SORT_ITEMS 256
#define SORT_LOCAL 2048          // pairs that are sorted in local memory at once
#define SHORT 64                 // pairs that the network sorts sooner
#define BUCKETS 1024              // of depth
#define BUCKET_LIMIT 128              // pairs of one range: more are not compared each with all
#define ROW 16                   // work-items whose sums are added up one after the other; SORT_ITEMS is its square
enum { ITEM_PAIRS = SORT_LOCAL / SORT_ITEMS, ITEM_BUCKETS = BUCKETS / SORT_ITEMS };   // of one work-item

// The places i < j of comparator t in the step whose partners are `stride` (a power of two) apart; in the first step of a
// block of 2 * stride places (`mirrored`) partners are mirror images.
static inline void comparator(uint t, uint stride, bool mirrored, uint *i, uint *j) {
    uint inside = t & (stride - 1);
    *i = 2 * t - inside;
    *j = mirrored ? *i + 2 * (stride - inside) - 1 : *i + stride;
}

// One step of the network on `items`, which lie where `fence` says.
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

// The depth that a key stands for: `sortable`, back.
static inline float depth_of(uint key) { return as_float((key & 0x80000000u) ? key & 0x7FFFFFFFu : ~key); }

// A pair's range of depth. Every step keeps the order of depths, so a pair of a later range is further. fmax: where all depths are
// one, or without end, the product may be no number.
static inline uint bucket_of(ulong pair, float nearest, float scale) {
    return (uint)fmin(fmax((depth_of((uint)(pair >> 32)) - nearest) * scale, 0.0f), BUCKETS - 1.0f);
}

typedef struct {             // in local memory, while a list is spread
    uint lowest, highest, overfull;    // keys; whether a range is
    uint rows[ROW];                   // pairs of each row of work-items
    uint starts[BUCKETS];              // pairs in each range, then where it starts
} Buckets;

// The least and the greatest key of `length` pairs. ends: SORT_ITEMS values for its own use.
static inline void find_key_range(global const ulong *pairs, uint length, local uint2 *scratch, local Buckets *buckets) {
    uint item = get_local_id(0), lowest = 0xFFFFFFFFu, highest = 0;
    for (uint k = item; k < length; k += SORT_ITEMS) {
        uint key = (uint)(pairs[k] >> 32);
        lowest = min(lowest, key);
        highest = max(highest, key);
    }
    scratch[item] = (uint2)(lowest, highest);
    barrier(CLK_LOCAL_MEM_FENCE);
    if (item < 2 * ROW) {    // few, as atomics of one place wait for each other
        for (uint k = item + 2 * ROW; k < SORT_ITEMS; k += 2 * ROW) {
            lowest = min(lowest, scratch[k].x);
            highest = max(highest, scratch[k].y);
        }
        atomic_min(&buckets->lowest, lowest);
        atomic_max(&buckets->highest, highest);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
}

// Turns the numbers of pairs in each range into where the range starts, unless one is crowded. sums: SORT_ITEMS values for its own
// use.
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

// Sorts at most SORT_LOCAL pairs into `list`: puts each into its range, where it counts those before it. Returns false, for the whole
// group, if a range is crowded. items: SORT_LOCAL values for its own use.
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
        bool all_stages = size == block;   // all stages of each block; later what a wider stage leaves to do within them
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
