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

// Indices in the buffer `frame_counts`, which the host reads: numbers of big splats, of pairs (64 bits), of visible splats.
enum { COUNT_BIG = 0, COUNT_PAIRS = 1, COUNT_VISIBLE = 3 };

// Class of a list by its length, 0 for the longest; there are SCAN_ITEMS classes.
static inline uint length_class(uint length) { return SCAN_ITEMS - 1 - min(length / 4, SCAN_ITEMS - 1u); }

// Lengths of the lists of four tiles from `first` on; 0 from tile `end` on.
static inline uint4 tile_lengths(global const uint *counters, uint first, uint end) {
    uint length[4];
    for (uint k = 0; k < 4; k++) length[k] = first + k < end ? counters[COUNTERS + first + k] : 0;
    return (uint4)(length[0], length[1], length[2], length[3]);
}

// Index space: work-groups of SCAN_ITEMS. The first one orders the tiles; each of the others computes the starts of its share of the
// tiles. Each adds up the lengths of all lists itself, so that none waits for another.
// Reads: counters. Writes: starts[tiles + 1] modulo 2^32, cursors[tiles] (the same), frame_counts, to which `emit` adds the number of visible
// splats; tile_order[tiles]: tiles by the classes of their lists, so that blending begins with the longest, in any order within a class.
// All lists are empty if there are more pairs than `capacity`, unless that is 2^32 - 1.
kernel __attribute__((reqd_work_group_size(SCAN_ITEMS, 1, 1))) void tile_starts(
//@@ arguments tile_starts
) {
    local ulong partial[SCAN_ITEMS];
    local uint classes[SCAN_ITEMS];
    uint item = get_local_id(0), group = get_group_id(0), shares = get_num_groups(0) - 1;
    ulong before = 0, pairs = 0, total;
    if (group == 0) {
        classes[item] = 0;
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint tile = item; tile < tiles; tile += SCAN_ITEMS) atomic_inc(classes + length_class(counters[COUNTERS + tile]));
        barrier(CLK_LOCAL_MEM_FENCE);
        classes[item] = (uint)scan_group(partial, item, classes[item], &total);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (uint tile = item; tile < tiles; tile += SCAN_ITEMS)
            tile_order[atomic_inc(classes + length_class(counters[COUNTERS + tile]))] = tile;
        return;
    }
    uint share = (tiles + 4 * shares - 1) / (4 * shares) * 4, from = min((group - 1) * share, tiles);
    uint to = min(from + share, tiles);
    for (uint first = 4 * item; first < tiles; first += 4 * SCAN_ITEMS) {
        uint4 lengths = tile_lengths(counters, first, tiles);
        ulong sum = (ulong)lengths.x + lengths.y + lengths.z + lengths.w;
        pairs += sum;
        if (first < from) before += sum;
    }
    scan_group(partial, item, pairs, &pairs);
    scan_group(partial, item, before, &before);
    bool fits = capacity == 0xFFFFFFFFu || pairs <= capacity;
    for (uint round = from; round < to; round += 4 * SCAN_ITEMS) {
        uint first = round + 4 * item;
        uint4 lengths = tile_lengths(counters, first, to);
        uint length[4] = {lengths.x, lengths.y, lengths.z, lengths.w};
        uint position = (uint)(before + scan_group(partial, item, (ulong)lengths.x + lengths.y + lengths.z + lengths.w, &total));
        for (uint k = 0; k < 4 && first + k < to; k++) {
            cursors[first + k] = position;
            starts[first + k] = fits ? position : 0;
            position += length[k];
        }
        before += total;
    }
    if (from == 0 && item == 0) {
        starts[tiles] = fits ? (uint)pairs : 0;
        frame_counts[COUNT_BIG] = counters[COUNTER_BIG];
        frame_counts[COUNT_VISIBLE] = 0;   // added up by `emit`
        frame_counts[COUNT_PAIRS] = (uint)pairs;
        frame_counts[COUNT_PAIRS + 1] = (uint)(pairs >> 32);
    }
}

// Work-items of a work-group of the per-splat kernels. A splat that overlaps more tiles than a window is shared by a team of them.
#define BIN_ITEMS 256

// Rectangle of tiles that a big splat may overlap. Counting and listing both call this, so they agree, and `tile_count`
// (record_gradients.cl), which numbers the gradient buffer offsets, agrees with both.
typedef struct { int top, left, columns, tiles, tiles_x; } TileRect;

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
    rect.tiles = ((y1 - 1) / TILE_H - rect.top + 1) * rect.columns;
    return rect;
}

// Number of tiles of a view.
static inline int tiles_of(int width, int height) {
    return ((width + TILE_W - 1) / TILE_W) * ((height + TILE_H - 1) / TILE_H);
}

// Index in the image of tile `k` of the rectangle; -1 if the splat does not overlap it.
static inline int rect_tile(const TileRect *rect, int k, const Bounds *b, int width, int height) {
    int row = rect->top + k / rect->columns, column = rect->left + k % rect->columns;
    TileSpan span = tile_span(b, row, width, height);
    return column >= span.first && column <= span.last ? row * rect->tiles_x + column : -1;
}

#define FIRST_DEPTH_KEY 0x01000000u   // below: coplanar groups (part/coplanar_layers.cl)
#define NO_OFFSET 0xFFFFFFFFu
#define NO_ENTRY 0xFFFFFFFFu
#define WINDOW_TILES (WINDOW_W * WINDOW_H)
#define QUEUED 0xFFFFu          // mask of the queue's length, which is at most BIN_ITEMS * WINDOW_TILES
#define ONE_VISIBLE 0x10000u    // the bits above count visible splats
#define UNROLL 4                // atomics in flight per work-item
#define TEAM 64                 // work-items that share a big splat
#define TEAMS (BIN_ITEMS / TEAM)
#define TEAM_TILES (8 * TEAM)   // the complete work-group lists a splat whose rectangle has more tiles
#define TEAM_DEFERRED 16        // maximum number of such splats of a team, which lists further ones itself

// Lists of the tiles [first_tile, end_tile), at most `capacity` pairs.
typedef struct {
    int tiles_x, first, end;
    uint start, capacity;
} TileRange;

// Next free index of a tile's list, or NO_OFFSET outside of the range. Modulo 2^32: indices within the range are right even if the
// frame has more pairs than that.
static inline uint next_offset(int tile, const TileRange *tile_range, global uint *restrict cursors, bool shared) {
    return tile < tile_range->first || tile >= tile_range->end ? NO_OFFSET : INCREMENT(cursors, tile, shared) - tile_range->start;
}

typedef struct {
    uint count;                 // splats of a view
    int width, height;
    global const uint *big;
    global const Bounds *bounds;
    global const uint *keys;
//@@ big_records
} BigSplats;

// Advances the cursors of all tiles that a big splat overlaps, and writes its pairs where the range has capacity for them.
// `items` work-items share the tiles of the rectangle; this one is number `item`.
static inline void list_big_splat(const BigSplats *splats, uint k, const TileRect *rect, const Bounds *b, int item, int items,
                                  const TileRange *tile_range, global uint *restrict cursors, global uint2 *restrict pairs) {
    uint splat = splats->big[k];
    int before = (int)(splat / splats->count) * tiles_of(splats->width, splats->height);
    for (int n = item; n < rect->tiles; n += items) {
        int tile = rect_tile(rect, n, b, splats->width, splats->height);
        uint position = tile < 0 ? NO_OFFSET : next_offset(before + tile, tile_range, cursors, false);
        if (position >= tile_range->capacity) continue;
        uint key = splats->keys[splat];
//@@ big_key
        pairs[position] = (uint2)(splat, key);
    }
}

// Lists every `groups`-th of the first `big_count` big splats, by a complete work-group: a team for each splat, then all teams for
// each splat of very many tiles. deferred: scratch.
static inline void list_big_splats(const BigSplats *splats, uint group, uint groups, uint big_count, const TileRange *tile_range,
                                   global uint *restrict cursors, global uint2 *restrict pairs, local uint (*deferred)[TEAM_DEFERRED + 1]) {
    uint item = get_local_id(0), team = item / TEAM, deferred_count = 0;
    for (uint k = group * TEAMS + team; k < big_count; k += groups * TEAMS) {
        const Bounds b = splats->bounds[k];
        const TileRect rect = tile_rect(&b, splats->width, splats->height);
        if (rect.tiles > TEAM_TILES && deferred_count < TEAM_DEFERRED) {
            deferred_count++;
            if (item % TEAM == 0) deferred[team][deferred_count] = k;
        } else list_big_splat(splats, k, &rect, &b, item % TEAM, TEAM, tile_range, cursors, pairs);
    }
    if (item % TEAM == 0) deferred[team][0] = deferred_count;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (team = 0; team < TEAMS; team++)
        for (uint n = 1; n <= deferred[team][0]; n++) {
            const Bounds b = splats->bounds[deferred[team][n]];
            const TileRect rect = tile_rect(&b, splats->width, splats->height);
            list_big_splat(splats, deferred[team][n], &rect, &b, item, BIN_ITEMS, tile_range, cursors, pairs);
        }
}

// Adds the tiles of big splats to the counters.
// Index space: any number of work-groups; each processes every n-th splat.
// Reads: counters[COUNTER_BIG], big, big_bounds.
kernel __attribute__((reqd_work_group_size(BIN_ITEMS, 1, 1))) void count_big(
//@@ arguments count_big
) {
    local uint deferred[TEAMS][TEAM_DEFERRED + 1];
    const BigSplats shared = {count, width, height, big, big_bounds};
    const TileRange no_pairs = {0, 0, INT_MAX, 0, 0};
    list_big_splats(&shared, get_group_id(0), get_num_groups(0), min(counters[COUNTER_BIG], big_capacity), &no_pairs, counters + COUNTERS, 0, deferred);
}

// Writes the (splat, key) pairs of all tiles of a range.
// Index space: for each view the same number of work-groups, which share the big splats, then `splat_groups` work-groups, one
// work-item per splat.
// Reads: windows, keys, starts, big, big_bounds. Reads and overwrites: cursors of the range. Writes: pairs; adds to
// frame_counts[COUNT_VISIBLE].
kernel __attribute__((reqd_work_group_size(BIN_ITEMS, 1, 1))) void emit(
//@@ arguments emit
) {
    local uint queued;          // length of the queue, and number of visible splats
    local ushort queue[BIN_ITEMS * WINDOW_TILES];     // (work-item of the splat, tile of its window)
    local uint corners[BIN_ITEMS], depths[BIN_ITEMS], deferred[TEAMS][TEAM_DEFERRED + 1];
    const TileRange tile_range = {(width + TILE_W - 1) / TILE_W, first_tile, end_tile, starts[first_tile], capacity};
    uint item = get_local_id(0), view_index = get_group_id(1), big_count = min(frame_counts[COUNT_BIG], big_capacity);
    if (item == 0) queued = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    uint groups = get_num_groups(0) - splat_groups, i = get_global_id(0) - groups * BIN_ITEMS;
    if (get_group_id(0) < groups) {     // the groups of big splats start first, since they may take long
        const BigSplats shared = {count, width, height, big, big_bounds, keys
//@@ big_record_arguments
        };
        list_big_splats(&shared, view_index * groups + get_group_id(0), groups * get_num_groups(1), big_count, &tile_range, cursors,
                        pairs, deferred);
    } else {
        uint splat = view_index * count + i;
        uint key = i < count ? keys[splat] : CULLED;
        uint2 window = key != CULLED ? windows[splat] : (uint2)(0);
        corners[item] = window.x;
        depths[item] = key;
        uint at = RESERVE(&queued, popcount(window.y) | (key != CULLED ? ONE_VISIBLE : 0u)) & QUEUED;
        for (; window.y != 0; window.y &= window.y - 1) queue[at++] = (ushort)(item * WINDOW_TILES + 31 - clz(window.y & -window.y));
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    // evenly shared, since splats overlap few or many tiles; several at once, since each atomic has latency
    int before = (int)view_index * tiles_of(width, height);
    uint first_splat = view_index * count + i - item;
    uint length = queued & QUEUED, visible = queued / ONE_VISIBLE;
    for (uint from = item; from < length; from += UNROLL * BIN_ITEMS) {
        uint positions[UNROLL], owners[UNROLL];
        bool shared = false;
        for (uint n = 0; n < UNROLL; n++) {
            uint entry = from + n * BIN_ITEMS < length ? queue[from + n * BIN_ITEMS] : NO_ENTRY;
            owners[n] = entry / WINDOW_TILES;
            positions[n] = NO_OFFSET;
            if (entry != NO_ENTRY) {
                int tile = before + window_tile((uint2)(corners[owners[n]], 1u << entry % WINDOW_TILES), tile_range.tiles_x);
                if (n == 0) shared = SHARES(tile);
                positions[n] = next_offset(tile, &tile_range, cursors, shared);
            }
        }
        for (uint n = 0; n < UNROLL; n++)
            if (positions[n] < tile_range.capacity) pairs[positions[n]] = (uint2)(first_splat + owners[n], depths[owners[n]]);
    }
    if (item == 0 && counts_visible && visible != 0) atomic_add(frame_counts + COUNT_VISIBLE, visible);
}

// Sorts each tile's list by (depth key, splat); all keys differ.
// Index space: work-groups of SORT_ITEMS, one per tile of the range.
// Reads: starts. Reads and overwrites: pairs. Writes: lists; counters, zeroed for the next frame if `clear`.
//
// A list is bucket-sorted by depth if its pairs, or their indices within the list, fit local memory. Longer and short lists, and those
// with an overfull bucket, go through a bitonic network; every comparator moves the smaller key to the front, as if the list were
// padded with infinities.
#define SORT_ITEMS 256
#define SORT_LOCAL 2048          // pairs sorted in local memory
#define SHORT 64                 // pairs for which the network is faster
#define BUCKETS 1024              // buckets of the depth range
#define BUCKET_LIMIT 128              // pairs of one bucket: larger ones are not sorted by comparing all pairs
#define ROW 16                   // work-items whose sums are added serially; SORT_ITEMS is its square
#define SORT_INDEXED (4 * SORT_LOCAL)    // pairs with 16-bit indices in that memory
enum { ITEM_BUCKETS = BUCKETS / SORT_ITEMS };   // per work-item

// Indices i < j of comparator t of a step with partners `stride` (a power of two) apart; in the first step of a block of
// 2 * stride elements (`mirrored`) partners are mirror images.
static inline void comparator(uint t, uint stride, bool mirrored, uint *i, uint *j) {
    uint inside = t & (stride - 1);
    *i = 2 * t - inside;
    *j = mirrored ? *i + 2 * (stride - inside) - 1 : *i + stride;
}

//@@ pair_order
#ifndef PAIR_BEFORE
#define PAIR_BEFORE(a, b) ((a) < (b))
#define COUNT_BEFORE(position, other, pair) position += (other) < (pair)
#endif

// One step of the network on `items`; `fence` names their address space.
#define SORT_STEP(items, length, comparators, stride, mirrored, fence)                      \
    for (uint t = get_local_id(0); t < (comparators); t += SORT_ITEMS) {                    \
        uint i, j;                                                                          \
        comparator(t, stride, mirrored, &i, &j);                                            \
        if (j < (length)) {                                                                 \
            ulong a = (items)[i], b = (items)[j];                                           \
            if (PAIR_BEFORE(b, a)) {                                                        \
                (items)[i] = b;                                                             \
                (items)[j] = a;                                                             \
            }                                                                               \
        }                                                                                   \
    }                                                                                       \
    barrier(fence)

// Bucket of a pair, monotonic in depth. fmax: where all depths are equal, or infinite, the product may be NaN.
static inline uint bucket_of(ulong pair, float nearest, float scale) {
    return (uint)fmin(fmax((key_depth((uint)(pair >> 32)) - nearest) * scale, 0.0f), BUCKETS - 1.0f);
}

typedef struct {             // state of the bucket sort, in local memory
    uint lowest, highest, overfull;    // lowest and highest key; whether any bucket is overfull
    uint rows[ROW];                   // pairs of each row of work-items
    uint starts[BUCKETS];              // number of pairs of each bucket, then its start
} Buckets;

// Lowest and highest key of `length` pairs. scratch: SORT_ITEMS values.
static inline void find_key_range(global const ulong *pairs, uint length, local uint2 *scratch, local Buckets *buckets) {
    uint item = get_local_id(0), lowest = 0xFFFFFFFFu, highest = 0;
    for (uint k = item; k < length; k += SORT_ITEMS) {
        uint key = (uint)(pairs[k] >> 32);
        lowest = min(lowest, key < FIRST_DEPTH_KEY ? 0xFFFFFFFFu : key);
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

// Sorts each bucket into `list`: within its bucket, a pair's place is the number of smaller keys. `starts` are the buckets' ends.
#define BUCKETED(position) (indexed ? pairs[((local ushort *)items)[position]] : items[position])
static inline void sort_buckets(global const ulong *pairs, uint length, local ulong *items, local Buckets *buckets, float nearest,
                              float scale, bool indexed, global uint *restrict list
//@@ pair_order_parameters
) {
    for (uint k = get_local_id(0); k < length; k += SORT_ITEMS) {
        ulong pair = BUCKETED(k);
        uint bucket = bucket_of(pair, nearest, scale), first = bucket > 0 ? buckets->starts[bucket - 1] : 0, position = first;
//@@ equal_start
        for (uint other = first, end = buckets->starts[bucket]; other < end; other++) COUNT_BEFORE(position, BUCKETED(other), pair);
//@@ equal_sorted
        list[position] = (uint)pair;
    }
}

// Bucket sort of at most SORT_INDEXED pairs into `list`. Returns false, for all work-items, if a bucket is overfull. items: scratch of
// SORT_LOCAL values.
static inline bool bucket_sort(global const ulong *pairs, uint length, local ulong *items, local Buckets *buckets,
                               global uint *restrict list
//@@ pair_order_parameters
) {
    uint item = get_local_id(0);
    if (item == 0) {
        buckets->lowest = 0xFFFFFFFFu;
        buckets->highest = buckets->overfull = 0;
    }
    for (uint k = item; k < BUCKETS; k += SORT_ITEMS) buckets->starts[k] = 0;
    barrier(CLK_LOCAL_MEM_FENCE);
    find_key_range(pairs, length, (local uint2 *)items, buckets);
    float nearest = key_depth(buckets->lowest), scale = BUCKETS / (key_depth(buckets->highest) - nearest);
    for (uint k = item; k < length; k += SORT_ITEMS) atomic_inc(buckets->starts + bucket_of(pairs[k], nearest, scale));
    barrier(CLK_LOCAL_MEM_FENCE);
    bucket_starts((local uint *)items, buckets);
    if (buckets->overfull) return false;
    for (uint k = item; k < length; k += SORT_ITEMS) {
        ulong pair = pairs[k];
        uint position = atomic_inc(buckets->starts + bucket_of(pair, nearest, scale));      // starts of buckets become their ends
        if (length > SORT_LOCAL) ((local ushort *)items)[position] = (ushort)k;
        else items[position] = pair;
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    if (length > SORT_LOCAL)
        sort_buckets(pairs, length, items, buckets, nearest, scale, true, list
//@@ pair_order_arguments
        );
    else
        sort_buckets(pairs, length, items, buckets, nearest, scale, false, list
//@@ pair_order_arguments
        );
    return true;
}

kernel __attribute__((reqd_work_group_size(SORT_ITEMS, 1, 1))) void sort_tiles(
//@@ arguments sort_tiles
) {
    local ulong items[SORT_LOCAL];
    local Buckets buckets;
    uint tile = first_tile + get_group_id(0), item = get_local_id(0);
    uint start = starts[tile] - starts[first_tile], length = starts[tile + 1] - starts[tile];
    global ulong *list = pairs + start;
    if (clear && item == 0) {
        counters[COUNTERS + tile] = 0;
        if (tile == 0) counters[COUNTER_BIG] = counters[COUNTER_VISIBLE] = 0;
    }
    if (length > SHORT && length <= SORT_INDEXED && bucket_sort(list, length, items, &buckets, lists + start
//@@ pair_order_arguments
    )) return;
    uint padded = 1;
    while (padded < length) padded *= 2;

    // blocks that fit local memory: all of a short list
    uint block = min(padded, (uint)SORT_LOCAL);
    for (uint size = block; size <= padded; size *= 2) {
        bool all_stages = size == block;   // of each block in the first round; later only strides that fit a block
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
