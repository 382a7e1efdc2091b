"""Tile binning: visible splats in depth order, then (splat, tile) pairs in that order.

Warp's scan and stable radix sort run between these kernels: visible splats are sorted by key (ties by index,
since they are compacted in that order), then pairs by tile (ties by depth, since they are emitted in that
order). There are no atomics.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from .bounds import Bounds, make_bounds, window_tile
from .common import CULLED, STRICT, View, lowest

# kernels that all feature sets share are one module
wp.set_module_options(STRICT)
NONE, ONE = wp.constant(wp.uint32(0)), wp.constant(wp.uint32(1))


@wp.kernel(enable_backward=False)
def compact(
    first: int,
    keys: wp.array(dtype=wp.uint32),  # (n)
    visible: wp.array(dtype=wp.int32),  # (n)
    offsets: wp.array(dtype=wp.int32),  # (n) inclusive sums of visible
    totals: wp.array(dtype=wp.int64),  # (2) visible splats, pairs
    capacity: int,  # size of the outputs, at most n; excess splats are dropped
    sorted_keys: wp.array(dtype=wp.uint32),  # out: keys of visible splats, by index, then CULLED
    order: wp.array(dtype=wp.int32),  # out: indices of visible splats
):
    i = wp.tid() + first
    if visible[i] != 0:
        k = offsets[i] - 1
        if k < capacity:
            sorted_keys[k] = keys[i]
            order[k] = i
    if i < capacity and wp.int64(i) >= totals[0]:
        sorted_keys[i] = CULLED


@wp.kernel(enable_backward=False)
def gather(
    first: int,
    order: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int64),
    totals: wp.array(dtype=wp.int64),  # (2) visible splats, pairs
    capacity: int,  # capacity in splats
    pairs: int,  # capacity in pairs
    lengths: wp.array(dtype=wp.int64),  # out: counts in depth order; all 0 if a capacity is too small
):
    k = wp.tid() + first
    lengths[k] = wp.int64(0)
    if wp.int64(k) < totals[0] and totals[0] <= wp.int64(capacity) and totals[1] <= wp.int64(pairs):
        lengths[k] = counts[order[k]]


@wp.kernel(enable_backward=False)
def find_starts(
    first: int,
    pairs: int,
    band_first: int,
    tiles: wp.array(dtype=wp.int32),  # sorted
    starts: wp.array(dtype=wp.int32),  # out: start of each tile's list
):
    tile = band_first + first + wp.tid()
    # Warp's search returns at most its last index, so the range has one more element
    starts[tile] = wp.lower_bound(tiles, 0, pairs + 1, tile)


@wp.kernel(enable_backward=False)
def sum_up(
    splats: int,
    offsets: wp.array(dtype=wp.int32),  # inclusive sums
    ends_by_index: wp.array(dtype=wp.int64),  # inclusive sums
    totals: wp.array(dtype=wp.int64),  # (2) out: visible splats, pairs
):
    totals[0] = wp.int64(offsets[splats - 1])
    totals[1] = ends_by_index[splats - 1]


@wp.func
def window_of(window: wp.uint64):
    """First tile of a window, and the bits of the splat's tiles; 0 if the tiles exceed a window."""
    return int(window >> wp.uint64(32)), wp.uint32(window & wp.uint64(0xFFFFFFFF))


@wp.func
def first_tile(index: int, view: View) -> int:
    """First tile of a splat's view."""
    return index / view.splats * (view.tiles_x * view.tiles_y)


@cache
def make_lists(screen: bool) -> SimpleNamespace:
    """Make count, histogram and emit, with or without the low-pass disc in the bounds."""
    limits = make_bounds(screen)

    @wp.func
    def band_span(b: Bounds, row: int, base: int, view: View, band_first: int, band_end: int):
        left, right = limits.tile_span(b, row, view)
        start = base + row * view.tiles_x
        return wp.max(left + start, band_first), wp.min(right + start, band_end)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def histogram(
        first: int,
        views: wp.array(dtype=View),
        order: wp.array(dtype=wp.int32),
        windows: wp.array(dtype=wp.uint64),
        bounds: wp.array(dtype=Bounds),
        tile_totals: wp.array(
            dtype=wp.int32
        ),  # out: lengths of lists; integer sums do not depend on the order of additions
    ):
        view = views[0]
        index = order[wp.tid() + first]
        corner, bits = window_of(windows[index])
        if bits == NONE:
            b = bounds[index]
            base = first_tile(index, view)
            row, end = limits.tile_rows(b, view)
            while row < end:
                left, right = limits.tile_span(b, row, view)
                for column in range(left, right):
                    wp.atomic_add(tile_totals, base + row * view.tiles_x + column, 1)
                row += 1
        while bits != NONE:
            wp.atomic_add(tile_totals, window_tile(corner, lowest(bits), view), 1)
            bits = bits & (bits - ONE)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def count(
        first: int,
        views: wp.array(dtype=View),
        band_first: int,
        band_end: int,
        order: wp.array(dtype=wp.int32),
        windows: wp.array(dtype=wp.uint64),
        bounds: wp.array(dtype=Bounds),
        lengths: wp.array(dtype=wp.int64),  # out: pairs of each splat in the band, in depth order
    ):
        view = views[0]
        k = wp.tid() + first
        index = order[k]
        corner, bits = window_of(windows[index])
        total = int(0)
        if bits == NONE:
            b = bounds[index]
            base = first_tile(index, view)
            row, end = limits.tile_rows(b, view)
            while row < end:
                left, right = band_span(b, row, base, view, band_first, band_end)
                total += wp.max(right - left, 0)
                row += 1
        while bits != NONE:
            tile = window_tile(corner, lowest(bits), view)
            bits = bits & (bits - ONE)
            if tile >= band_first and tile < band_end:
                total += 1
        lengths[k] = wp.int64(total)

    @wp.kernel(module="unique", module_options=STRICT, enable_backward=False)
    def emit(
        first: int,
        views: wp.array(dtype=View),
        band_first: int,
        band_end: int,
        order: wp.array(dtype=wp.int32),
        windows: wp.array(dtype=wp.uint64),
        bounds: wp.array(dtype=Bounds),
        ends: wp.array(dtype=wp.int64),  # inclusive sums of lengths
        lengths: wp.array(dtype=wp.int64),
        capacity: int,  # size of `ends`
        pairs: int,  # capacity of the outputs
        end_tile: int,  # number of tiles
        tiles: wp.array(dtype=wp.int32),  # out: pairs in depth order, then end_tile
        lists: wp.array(dtype=wp.int32),  # out: splat of each pair
    ):
        k = wp.tid() + first
        rest = int(ends[capacity - 1]) + k
        while rest < pairs:
            tiles[rest] = end_tile
            rest += capacity
        if lengths[k] == wp.int64(0):
            return  # `order` may be undefined here
        view = views[0]
        index = order[k]
        place = int(ends[k] - lengths[k])
        corner, bits = window_of(windows[index])
        if bits == NONE:
            b = bounds[index]
            base = first_tile(index, view)
            row, end = limits.tile_rows(b, view)
            while row < end:
                left, right = band_span(b, row, base, view, band_first, band_end)
                for tile in range(left, right):
                    tiles[place] = tile
                    lists[place] = index
                    place += 1
                row += 1
        while bits != NONE:
            tile = window_tile(corner, lowest(bits), view)
            bits = bits & (bits - ONE)
            if tile >= band_first and tile < band_end:
                tiles[place] = tile
                lists[place] = index
                place += 1

    return SimpleNamespace(histogram=histogram, count=count, emit=emit)
