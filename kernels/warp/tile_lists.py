"""Tile binning: projection counts the (splat, tile) pairs of each tile, the pairs are written to the lists of
their tiles in any order, and each list is sorted by depth, ties by index. Pairs are unique, so the lists do
not depend on the order of the atomic additions.

A splat that overlaps more tiles than a window is big: its tiles are shared by a block of threads. On the
CPU a block is one thread, and atomic additions serve several host threads.
"""

from functools import cache

import warp as wp

from .bounds import Bounds, make_bounds, ones, window_tile
from .common import CULLED, STRICT, View, lowest, population, with_numbers

# kernels that all feature sets share are one module
wp.set_module_options(STRICT)
NONE, ONE, HIGH = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1)), wp.constant(wp.uint64(32))
BLOCK = 256
"""threads of a block on a GPU that writes or sorts pairs"""
START_BLOCK = 1024
"""threads of the block that computes the starts of all lists"""
COUNTERS = wp.constant(128)
"""counters before the counters of tiles: the number of big splats, then the last 64, whose sum is the
number of visible splats, so that not all warps add to one address"""
SHARED_SPLATS = wp.constant(32)
"""maximum number of big splats that a block shares at once"""
_NUMBERS = {"BLOCK": BLOCK, "COUNTERS": 128, "VISIBLE": 64}
_SORT = {"BLOCK": BLOCK, "BUCKETS": 1024, "LIMIT": 128, "LOCAL": 2048, "INDEXED": 8192, "DEPTHS": 0x01000000}
"""LIMIT: maximum pairs of a bucket. LOCAL, INDEXED: pairs, and 16-bit indices of pairs, that fit shared
memory. DEPTHS: lowest key of a depth; those of coplanar groups are below"""

# Inclusive prefix sum of a number of each thread over its warp.
_WARP_PREFIX_SUM = """
#if defined(__CUDA_ARCH__)
    auto warp_prefix_sum = [](int sum) {
        for (int step = 1; step < 32; step *= 2) {
            const int before = __shfl_up_sync(0xffffffffu, sum, step);
            if ((threadIdx.x & 31) >= step) sum += before;
        }
        return sum;
    };
#endif
"""
_THREADS_SHARE_TILE = """
#if defined(__CUDA_ARCH__)
    const unsigned int active = __activemask(), same = __match_any_sync(active, tile);
    return __any_sync(active, (same & (same - 1)) != 0);
#else
    return false;
#endif
"""
_INCREMENT = """
#if defined(__CUDA_ARCH__)
    int* counter = counters.data + index;
    if (!shared) return atomicAdd(counter, 1);
    const unsigned int same = __match_any_sync(__activemask(), index);
    const unsigned int before = (1u << (threadIdx.x & 31)) - 1;
    const int leader = __ffs(same) - 1;
    int first = 0;
    if ((same & before) == 0) first = atomicAdd(counter, __popc(same));
    return __shfl_sync(same, first, leader) + __popc(same & before);
#else
    return __atomic_fetch_add(counters.data + index, 1, __ATOMIC_RELAXED);
#endif
"""
_COUNT_VISIBLE = """
#if defined(__CUDA_ARCH__)
    const unsigned int active = __activemask();
    if ((threadIdx.x & 31) == __ffs(active) - 1)
        atomicAdd(counters.data + VISIBLE + blockIdx.x % VISIBLE, __popc(active));
#else
    __atomic_fetch_add(counters.data + VISIBLE, 1, __ATOMIC_RELAXED);
#endif
"""
_SHARED_MEMORY = """
#if defined(__CUDA_ARCH__)
    __shared__ int ends[BLOCK + BLOCK / 32];
    return static_cast<wp::uint64>(__cvta_generic_to_shared(ends));
#else
    return 0;
#endif
"""
_BLOCK_PREFIX_SUM = """
#if defined(__CUDA_ARCH__)
    int* ends = static_cast<int*>(__cvta_shared_to_generic(shared_memory));
    const int lane = threadIdx.x & 31, warp = threadIdx.x / 32;
    int sum = warp_prefix_sum(count);
    __syncthreads();  // the earlier entries have been processed
    if (lane == 31) ends[BLOCK + warp] = sum;
    __syncthreads();
    for (int before = 0; before < warp; before++) sum += ends[BLOCK + before];
    ends[threadIdx.x] = sum;
    __syncthreads();
    return ends[BLOCK - 1];
#else
    return count;
#endif
"""
_OWNER = """
#if defined(__CUDA_ARCH__)
    const int* ends = static_cast<const int*>(__cvta_shared_to_generic(shared_memory));
    int owner = 0;
    for (int step = BLOCK / 2; step > 0; step /= 2)
        if (ends[owner + step - 1] <= entry) owner += step;
    return owner;
#else
    return 0;
#endif
"""
_FIRST_ENTRY = """
#if defined(__CUDA_ARCH__)
    return owner > 0 ? static_cast<const int*>(__cvta_shared_to_generic(shared_memory))[owner - 1] : 0;
#else
    return 0;
#endif
"""
# On a GPU, tiles with long lists are first in `tile_order`, in any order within a class of lengths.
_START = """
    const int* lengths = counters.data + COUNTERS;
    wp::int64 total = 0;
#if defined(__CUDA_ARCH__)
    __shared__ wp::int64 totals_of_warps[32];
    __shared__ int sums[32], classes[1024];
    const int item = threadIdx.x, lane = item & 31, warp = item / 32;
    auto class_of = [](int length) { return 1023 - min(length / 4, 1023); };
    auto block_prefix_sum = [&](int sum) {  // inclusive
        sum = warp_prefix_sum(sum);
        __syncthreads();
        if (lane == 31) sums[warp] = sum;
        __syncthreads();
        int before = lane < warp ? sums[lane] : 0;
        for (int step = 16; step > 0; step /= 2) before += __shfl_xor_sync(0xffffffffu, before, step);
        return sum + before;
    };
    classes[item] = 0;
    __syncthreads();
    for (int tile = first + item; tile < end; tile += 1024) {
        total += lengths[tile];
        atomicAdd(classes + class_of(lengths[tile]), 1);
    }
    for (int step = 16; step > 0; step /= 2) total += __shfl_xor_sync(0xffffffffu, total, step);
    totals_of_warps[warp] = total;
    __syncthreads();
    total = 0;
    for (int other = 0; other < 32; other++) total += totals_of_warps[other];
    const bool fits = total <= capacity;
    const int tiles_of_class = classes[item];
    classes[item] = block_prefix_sum(tiles_of_class) - tiles_of_class;
    const int visible = block_prefix_sum(item < VISIBLE ? counters.data[VISIBLE + item] : 0);
    int position = 0;
    for (int round = first; round < end; round += 1024) {
        const int tile = round + item, length = tile < end ? lengths[tile] : 0;
        const int after = position + block_prefix_sum(length);
        if (tile < end) {
            cursors.data[tile] = after - length;
            starts.data[tile] = fits ? after - length : 0;
            tile_order.data[first + atomicAdd(classes + class_of(length), 1)] = tile;
        }
        for (int other = 0; other < 32; other++) position += sums[other];
    }
    if (item < 1023) return;
#else
    for (int tile = first; tile < end; tile++) total += lengths[tile];
    const bool fits = total <= capacity;
    int position = 0, visible = 0;
    for (int tile = first; tile < end; tile++) {
        cursors.data[tile] = position;
        starts.data[tile] = fits ? position : 0;
        tile_order.data[tile] = tile;
        position += lengths[tile];
    }
    for (int part = 0; part < VISIBLE; part++) visible += counters.data[VISIBLE + part];
#endif
    starts.data[end] = fits ? static_cast<int>(total) : 0;
    totals.data[0] = visible;
    totals.data[1] = total;
"""
# A list is distributed to buckets of keys, and the position of a pair in its bucket is the number of smaller
# pairs; a short list is one bucket. Lists that are too long or have an overfull bucket are sorted by a
# bitonic network.
_SORT_LIST = """
    wp::uint64* from = pairs.data + start;
    int* list = lists.data + start;
#if defined(__CUDA_ARCH__)
    __shared__ wp::uint64 items[LOCAL];
    __shared__ int ends[BUCKETS], sums[BLOCK / 32];
    __shared__ unsigned int lowest, highest;
    unsigned short* indices = reinterpret_cast<unsigned short*>(items);
    const int item = threadIdx.x, lane = item & 31, warp = item / 32;
    const bool local = length <= LOCAL;
    bool overfull = length > INDEXED;
    unsigned int nearest = 0, scale = 0;
    auto pair_at = [&](int position) { return local ? items[position] : from[indices[position]]; };
    auto bucket_of = [&](wp::uint64 pair) {
        const unsigned int key = static_cast<unsigned int>(pair >> 32);
        return static_cast<int>(__umulhi(max(key, nearest) - nearest, scale));
    };
    if (length <= LIMIT) {
        if (item < length) items[item] = from[item];
        __syncthreads();
        if (item < length) {
            int position = 0;
            for (int other = 0; other < length; other++) position += items[other] < items[item];
            list[position] = static_cast<int>(items[item]);
        }
        return;
    }
    if (!overfull) {
        if (item == 0) {
            lowest = 0xffffffffu;
            highest = 0;
        }
        for (int bucket = item; bucket < BUCKETS; bucket += BLOCK) ends[bucket] = 0;
        __syncthreads();
        unsigned int low = 0xffffffffu, high = 0;
        for (int k = item; k < length; k += BLOCK) {
            const unsigned int key = static_cast<unsigned int>(from[k] >> 32);
            if (key >= DEPTHS) low = min(low, key);
            high = max(high, key);
        }
        for (int step = 16; step > 0; step /= 2) {
            low = min(low, __shfl_xor_sync(0xffffffffu, low, step));
            high = max(high, __shfl_xor_sync(0xffffffffu, high, step));
        }
        if (lane == 0) {
            atomicMin(&lowest, low);
            atomicMax(&highest, high);
        }
        __syncthreads();
        nearest = min(lowest, highest);
        const wp::uint64 range = wp::uint64(highest - nearest) + 1;
        const wp::uint64 factor = (static_cast<wp::uint64>(BUCKETS) << 32) / range;
        scale = static_cast<unsigned int>(min(factor, wp::uint64(0xffffffffu)));
        for (int k = item; k < length; k += BLOCK) atomicAdd(ends + bucket_of(from[k]), 1);
        __syncthreads();
        constexpr int per_thread = BUCKETS / BLOCK;
        int lengths[per_thread], own = 0;
        for (int n = 0; n < per_thread; n++) {
            lengths[n] = ends[per_thread * item + n];
            overfull = overfull || lengths[n] > LIMIT;
            own += lengths[n];
        }
        int sum = warp_prefix_sum(own);
        if (lane == 31) sums[warp] = sum;
        overfull = __syncthreads_or(overfull);
        for (int before = 0; before < warp; before++) sum += sums[before];
        sum -= own;
        for (int n = 0; n < per_thread; n++) {
            ends[per_thread * item + n] = sum;
            sum += lengths[n];
        }
        __syncthreads();
    }
    if (!overfull) {
        for (int k = item; k < length; k += BLOCK) {
            const wp::uint64 pair = from[k];
            const int position = atomicAdd(ends + bucket_of(pair), 1);  // starts of buckets become their ends
            if (local) items[position] = pair;
            else indices[position] = static_cast<unsigned short>(k);
        }
        __syncthreads();
        for (int k = item; k < length; k += BLOCK) {
            const wp::uint64 pair = pair_at(k);
            const int bucket = bucket_of(pair), end = ends[bucket];
            int position = bucket > 0 ? ends[bucket - 1] : 0;
            for (int other = position; other < end; other++) position += pair_at(other) < pair;
            list[position] = static_cast<int>(pair);
        }
        return;
    }
    // every comparator moves the smaller pair to the front, as if the list were padded with infinities
    auto step = [&](wp::uint64* pairs, int length, int comparators, int stride, bool mirrored) {
        for (int t = item; t < comparators; t += BLOCK) {
            const int inside = t & (stride - 1), i = 2 * t - inside;
            const int j = mirrored ? i + 2 * (stride - inside) - 1 : i + stride;
            if (j < length && pairs[j] < pairs[i]) {
                const wp::uint64 pair = pairs[i];
                pairs[i] = pairs[j];
                pairs[j] = pair;
            }
        }
        __syncthreads();
    };
    int padded = 1;
    while (padded < length) padded *= 2;
    const int block = min(padded, LOCAL);
    for (int size = block; size <= padded; size *= 2) {
        for (int stride = size / 2; stride >= LOCAL; stride /= 2)
            step(from, length, padded / 2, stride, stride == size / 2);
        for (int base = 0; base < length; base += block) {
            const int here = min(length - base, block);
            for (int k = item; k < here; k += BLOCK) items[k] = from[base + k];
            __syncthreads();
            // all steps of a block at first, then those within the blocks
            for (int part = size == block ? 2 : block; part <= block; part *= 2)
                for (int stride = part / 2; stride > 0; stride /= 2)
                    step(items, here, block / 2, stride, size == block && stride == part / 2);
            for (int k = item; k < here; k += BLOCK) {
                from[base + k] = items[k];
                if (size == padded) list[base + k] = static_cast<int>(items[k]);
            }
            __syncthreads();
        }
    }
#else
    for (int gap = length; gap > 1;) {  // Shell sort
        gap = gap > 2 ? (5 * gap - 1) / 11 : 1;
        for (int i = gap; i < length; i++) {
            const wp::uint64 pair = from[i];
            int k = i;
            for (; k >= gap && from[k - gap] > pair; k -= gap) from[k] = from[k - gap];
            from[k] = pair;
        }
    }
    for (int k = 0; k < length; k++) list[k] = static_cast<int>(from[k]);
#endif
"""


@wp.func_native(_THREADS_SHARE_TILE)
def threads_share_tile(tile: int) -> bool:
    """Whether several active threads of the warp have the same tile."""
    ...


@wp.func_native(_INCREMENT)
def increment(counters: wp.array(dtype=wp.int32), index: int, shared: bool) -> int:
    """Add 1 to a counter; returns its value before. shared: use one atomic addition for all threads of the
    warp with the same index, since additions to one address are serialised.
    """
    ...


@wp.func_native(with_numbers(_COUNT_VISIBLE, _NUMBERS))
def count_visible(counters: wp.array(dtype=wp.int32)):
    """Count a visible splat."""
    ...


@wp.func_native(with_numbers(_SHARED_MEMORY, _NUMBERS))
def shared_memory() -> wp.uint64:
    """Address of the block's shared memory, for the functions below."""
    ...


@wp.func_native(with_numbers(_WARP_PREFIX_SUM + _BLOCK_PREFIX_SUM, _NUMBERS))
def block_prefix_sum(shared_memory: wp.uint64, count: int) -> int:
    """Inclusive prefix sum, in shared memory, of the number of entries of each thread of the block; returns
    the total. A barrier.
    """
    ...


@wp.func_native(with_numbers(_OWNER, _NUMBERS))
def owner_of(shared_memory: wp.uint64, entry: int) -> int:
    """Thread whose entry has this number: a binary search in the prefix sum."""
    ...


@wp.func_native(_FIRST_ENTRY)
def first_entry(shared_memory: wp.uint64, owner: int) -> int:
    """Number of entries of all threads before `owner`."""
    ...


@wp.func_native(with_numbers(_WARP_PREFIX_SUM + _START, _NUMBERS))
def start(
    counters: wp.array(dtype=wp.int32),
    first: int,
    end: int,
    capacity: int,
    totals: wp.array(dtype=wp.int64),
    cursors: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    tile_order: wp.array(dtype=wp.int32),
):
    """See `start_lists`."""
    ...


@wp.func_native(with_numbers(_WARP_PREFIX_SUM + _SORT_LIST, _SORT))
def sort_list(pairs: wp.array(dtype=wp.uint64), lists: wp.array(dtype=wp.int32), start: int, length: int):
    """Sort pairs[start : start + length] into `lists`."""
    ...


@wp.kernel(module="unique", module_options=STRICT, enable_backward=False, launch_bounds=START_BLOCK)
def start_lists(
    first_tile: int,
    counters: wp.array(dtype=wp.int32),
    end_tile: int,
    capacity: int,  # all lists are empty if there are more pairs
    totals: wp.array(dtype=wp.int64),  # (2) out: visible splats, pairs of the range
    cursors: wp.array(dtype=wp.int32),  # (tiles) out: next position in each tile's list
    starts: wp.array(dtype=wp.int32),  # (tiles + 1) out: start of each tile's list
    tile_order: wp.array(dtype=wp.int32),  # (tiles) out: tiles of the range
):
    start(counters, first_tile, end_tile, capacity, totals, cursors, starts, tile_order)


@wp.func
def list_pair(
    tile: int,
    key: wp.uint32,
    index: int,
    shared: bool,
    first_tile: int,
    end_tile: int,
    cursors: wp.array(dtype=wp.int32),
    first_cursor: int,
    capacity: int,
    pairs: wp.array(dtype=wp.uint64),
):
    """Advance the cursor of a tile of the range, and write the pair if there is capacity for it."""
    if tile >= first_tile and tile < end_tile:
        position = increment(cursors, first_cursor + tile, shared)
        if position >= 0 and position < capacity:
            pairs[position] = (wp.uint64(key) << HIGH) | wp.uint64(index)


@wp.kernel(enable_backward=False)
def list_windows(
    first: int,
    splats: int,
    views: wp.array(dtype=View),
    first_tile: int,
    end_tile: int,
    keys: wp.array(dtype=wp.uint32),
    windows: wp.array(dtype=wp.uint64),
    cursors: wp.array(dtype=wp.int32),
    capacity: int,  # size of `pairs`
    pairs: wp.array(dtype=wp.uint64),  # out: (key, splat)
):
    """Write the pairs of all splats that are not big, shared evenly by the threads of a block."""
    view = views[0]
    i = first + wp.tid()
    item, step = wp.tid() % wp.block_dim(), wp.block_dim()
    count = int(0)
    if i < splats:
        if keys[i] != CULLED:
            corner, bits = window_of(windows[i])
            count = population(bits)
    entries = shared_memory()
    total = block_prefix_sum(entries, count)
    entry, shared = int(item), bool(False)
    while entry < total:
        owner = owner_of(entries, entry)
        index = i - item + owner
        corner, bits = window_of(windows[index])
        tile = window_tile(corner, nth_bit(bits, entry - first_entry(entries, owner)), view)
        if entry < step:
            shared = threads_share_tile(tile)
        list_pair(tile, keys[index], index, shared, first_tile, end_tile, cursors, 0, capacity, pairs)
        entry += step


@wp.kernel(enable_backward=False)
def sort_lists(
    first_tile: int,  # tile of block 0
    starts: wp.array(dtype=wp.int32),
    pairs: wp.array(dtype=wp.uint64),  # sorted in any order
    lists: wp.array(dtype=wp.int32),  # out: splats of each tile in depth order
):
    tile = first_tile + wp.tid() / wp.block_dim()
    sort_list(pairs, lists, starts[tile], starts[tile + 1] - starts[tile])


@wp.func
def window_of(window: wp.uint64):
    """First tile of a window, and the bits of the splat's tiles; 0 if the tiles exceed a window."""
    return int(window >> HIGH), wp.uint32(window & wp.uint64(0xFFFFFFFF))


@wp.func
def nth_bit(bits: wp.uint32, n: int) -> int:
    """Index of the set bit before which n bits are set."""
    position, remaining, step = int(0), int(n), int(16)
    while step > 0:
        below = population((bits >> wp.uint32(position)) & ones(step))
        if remaining >= below:
            remaining -= below
            position += step
        step = step / 2
    return position


@wp.func
def corner_tile(index: int, view: View) -> int:
    """First tile of a splat's view."""
    return index / view.splats * (view.tiles_x * view.tiles_y)


@wp.func
def count_tiles(
    index: int,
    corner: int,
    bits: wp.uint32,
    view: View,
    counters: wp.array(dtype=wp.int32),
    big: wp.array(dtype=wp.int32),
):
    """Count a visible splat and the tiles of its window, or add it to the big splats."""
    count_visible(counters)
    rest = wp.uint32(bits)
    if rest == NONE:
        big[increment(counters, 0, True)] = index
        return
    shared = threads_share_tile(window_tile(corner, lowest(rest), view))
    while rest != NONE:
        increment(counters, COUNTERS + window_tile(corner, lowest(rest), view), shared)
        rest = rest & (rest - ONE)


@cache
def make_list_big(has_lowpass_disc: bool):
    """Make the kernel list_big, with or without the low-pass disc in the bounds."""
    limits = make_bounds(has_lowpass_disc)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def list_big(
        first: int,  # number of block 0
        blocks: int,  # of all launches
        views: wp.array(dtype=View),
        first_tile: int,
        end_tile: int,
        counters: wp.array(dtype=wp.int32),
        big: wp.array(dtype=wp.int32),
        keys: wp.array(dtype=wp.uint32),
        bounds: wp.array(dtype=Bounds),
        cursors: wp.array(dtype=wp.int32),
        first_cursor: int,  # cursor of tile 0
        capacity: int,  # size of `pairs`; 0: only advance the cursors, to count tiles
        pairs: wp.array(dtype=wp.uint64),  # out: (key, splat)
    ):
        """Write the pairs of big splats. The tiles in the rectangles of several splats are shared evenly by
        the threads of a block.
        """
        view = views[0]
        item, step = wp.tid() % wp.block_dim(), wp.block_dim()
        count = counters[0]
        per_block = wp.clamp((count + blocks - 1) / blocks, 1, wp.min(SHARED_SPLATS, step))
        base = first + wp.tid() / step
        entries = shared_memory()
        while base < count:
            tiles = int(0)
            # the splats of a block are not neighbours in the list, since large ones often are
            if item < per_block and base + item * blocks < count:
                left, top, columns, rows = limits.tile_rectangle(bounds[big[base + item * blocks]], view)
                tiles = columns * rows
            total = block_prefix_sum(entries, tiles)
            entry = int(item)
            while entry < total:
                owner = owner_of(entries, entry)
                index = big[base + owner * blocks]
                b = bounds[index]
                left, top, columns, rows = limits.tile_rectangle(b, view)
                n = entry - first_entry(entries, owner)
                row, column = top + n / columns, left + n % columns
                begin, end = limits.tile_span(b, row, view)
                if column >= begin and column < end:
                    tile = corner_tile(index, view) + row * view.tiles_x + column
                    key = keys[index]
                    list_pair(
                        tile, key, index, False, first_tile, end_tile, cursors, first_cursor, capacity, pairs
                    )
                entry += step
            base += blocks * per_block

    return list_big
