"""Tile binning: the splats of each tile, in depth order, by one of three strategies.

- `sort_first`: radix-sort the visible splats by depth, then append them to the tile lists in this order, by a
  counting sort. CPUs use it, since it has long sequential loops and no atomics. All devices use it to project
  in slices.
- `bin_first`, on GPUs: count the splats of each tile during the projection, write the (splat, tile) pairs in
  any order, and sort each tile's list in local memory.
- `bin_local`: like `bin_first`, but count in local memory. It is for many small views, and for stores, where
  neighbouring splats would increment one tile's counter at the same time.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.counts import BIG, COUNTERS, PAIRS, VISIBLE, Counts, enlarged
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.backends.opencl.memory_plan import KEY_BYTES, MIN_BIG, WINDOW_BYTES
from fidsplat.backends.opencl.morton_order import CULLING_GROUP
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.ranges import split_by_cost
from fidsplat.util.errors import DeviceError

LOCAL_TILES = 4096
"""maximum tiles of a view that are counted in local memory (as in tile_lists_local.cl)"""
_WORK_GROUP_SPLATS = 4096
"""splats per work-group of the strategy `bin_local` (as in tile_lists_local.cl)"""
_ITEMS = 256
"""work-group size: BIN_ITEMS, SORT_ITEMS and CULL_ITEMS of the kernels"""
_START_TILES, _MAX_START_GROUPS = 512, 32
"""tiles per work-group of the kernel `tile_starts`, and maximum number of work-groups: each reads all list
lengths"""
_MIN_UNCULLED = 1 << 12
"""initial capacity for splats in groups that are not culled"""
_NO_WINDOW = np.array([0xFFFFFFFF, 0], np.uint32)
"""window of a splat without tiles: an index beyond the end of `big`, and no bits"""


class TileRange(NamedTuple):
    """Tiles [first, end) that are listed together, and their number of pairs."""

    first: int
    end: int
    pairs: int


def allocate_counters(frame: DeviceFrame, words: int, big: int = 0) -> None:
    """Allocate zeroed counters, and buffers for at least `big` splats that touch many tiles."""
    capacity = max(big * 5 // 4, frame.pool.size("big") // 4, MIN_BIG)
    frame.scalars["big_capacity"] = capacity
    frame.scratch("big", 4 * capacity)
    frame.scratch("big_bounds", frame.source.records["Bounds"].itemsize * capacity)
    if not frame.waits:  # the kernel sort_tiles clears them for the next replay
        frame.buffers.counters = frame.pool.zeroed("counters", 4 * words, frame.queue)
        return
    counters = frame.scratch("counters", 4 * words)
    cl.enqueue_fill_buffer(frame.queue, counters, np.zeros(1, np.uint32), 0, 4 * words)


def cull(frame: DeviceFrame, big: int) -> None:
    """List the groups of splats that are not culled by their bounding spheres, and set
    `frame.records_per_view`. big: see `allocate_counters`, which is called again if the buffer `unculled`
    must be enlarged."""
    pool, culling_groups = frame.pool, -(-frame.cloud.count // CULLING_GROUP)
    frame.scratch("unculled", 4 * _MIN_UNCULLED // CULLING_GROUP)
    for name in ("spheres", "max_scales", "splat_ids"):
        frame.named[name] = frame.cloud.sorted_array(name)
    while True:
        capacity = min(pool.size("unculled") // 4, culling_groups)
        frame.records_per_view = CULLING_GROUP * capacity
        arguments = {"groups": culling_groups, "capacity": capacity}
        frame.launch("project", "cull_groups", (culling_groups,), (_ITEMS,), **arguments)
        if not frame.waits:
            break
        # `cull_groups` counts the groups that are not culled in this counter
        unculled = int(frame.read("counters", np.uint32, (COUNTERS,))[VISIBLE])
        if unculled <= capacity:
            break
        frame.scratch("unculled", 4 * min(unculled * 33 // 32, culling_groups))
        allocate_counters(frame, COUNTERS + frame.tiles, big)


def project(frame: DeviceFrame, first: int, end: int) -> None:
    """Project splats [first, end), or only those that passed `cull`: write their records, sort keys and tile
    windows."""
    count, size = end - first, _splat_capacity(frame, end - first)
    if frame.config.culls_first:
        size = frame.records_per_view
    frame.scratch("splats", size * frame.source.records["Splat"].itemsize)
    frame.scratch("keys", KEY_BYTES * size)
    windows = frame.scratch("windows", WINDOW_BYTES * size)
    if frame.view.sample_rows is not None and size:
        # the kernel writes no window for splats outside `View.sample_rows`, so windows are first set to empty
        cl.enqueue_fill_buffer(frame.queue, windows, _NO_WINDOW, 0, WINDOW_BYTES * size)
    if count:
        cloud, names = frame.cloud, frame.source.cloud_arrays
        if frame.config.culls_first:
            arrays, count = {name: cloud.sorted_array(name) for name in names}, size
        else:
            arrays = {name: cloud.array_in_cloud_order(name, first, end) for name in names}
        splats_per_item = frame.config.splats_per_item
        items, local_size = (count, 64) if splats_per_item == 1 else (-(-count // splats_per_item), 1)
        frame.launch("project", "project", (items,), (local_size,), frame.view_count, count=count, **arrays)


def _splat_capacity(frame: DeviceFrame, count: int) -> int:
    """Number of elements of a buffer with one per splat and view; for a complete cloud it is rounded up."""
    cloud = frame.cloud
    return frame.view_count * (cloud.padded_count if count == cloud.count else count)


# on CPUs: sort by depth, then append to tile lists


def sort_by_depth(frame: DeviceFrame, count: int) -> None:
    """Radix sort of the visible splats by depth, ties by index."""
    views, blocks, bins = frame.view_count, frame.config.sort_blocks, 1 << frame.config.radix_bits
    table = frame.scratch("sort table", 4 * bins * blocks * views)
    size = 4 * _splat_capacity(frame, count)
    keys, order = frame.buffers.keys, frame.scratch("order 0", size)
    for number, shift in enumerate(range(0, 32, frame.config.radix_bits)):
        keys_out = frame.scratch(f"sorted keys {number % 2}", size)
        order_out = frame.scratch(f"order {(number + 1) % 2}", size)
        digit = {"keys": keys, "count": count, "first": number == 0, "shift": shift, "table": table}
        frame.launch("sort", "sort_count", (blocks,), (1,), views, **digit)
        starts = _prefix_sums(frame, "sort", table, bins, VISIBLE, views)
        out = {"starts": starts, "indices": order, "keys_out": keys_out, "indices_out": order_out}
        frame.launch("sort", "sort_scatter", (blocks,), (1,), views, **digit, **out)
        keys, order = keys_out, order_out
    frame.buffers.order = order


def count_pairs(frame: DeviceFrame, count: int) -> Counts:
    """Count the length of each tile's list; waits for the totals."""
    views = frame.view_count
    table = frame.scratch("bin table", 4 * frame.tiles * frame.config.sort_blocks)
    frame.launch("bin", "bin_count", (frame.config.sort_blocks,), (1,), views, table=table, count=count)
    # tiles of all views are numbered consecutively, view after view
    frame.buffers.starts = _prefix_sums(frame, "bin", table, frame.tiles // views, PAIRS, 1)
    frame.launches_until_counts = len(frame.events)
    return Counts.of_counters(frame.read("counters", np.uint32, (views, COUNTERS)))


def tile_ranges(frame: DeviceFrame, first: int, end: int, pairs: int) -> list[TileRange]:
    """Split tiles [first, end) with these pairs into as many ranges as the pair budget requires."""
    budget = frame.workspace.pair_budget
    if pairs <= budget:
        return [TileRange(first, end, pairs)]
    frame.in_tile_ranges = True
    ranges = split_by_cost(tile_pairs(frame)[first:end], budget, first)
    return [TileRange(*tile_range) for tile_range in ranges]


def tile_pairs(frame: DeviceFrame) -> np.ndarray:
    """(tiles,) lengths of the lists, after they are counted."""
    if frame.config.binning == "sort_first":
        return frame.read("bin totals", np.uint32, (frame.tiles,))
    return frame.read("counters", np.uint32, (COUNTERS + frame.tiles,))[COUNTERS:]


def fill_sorted_lists(frame: DeviceFrame, tile_range: TileRange, count: int) -> None:
    """Append the sorted splats to the lists of a range of tiles."""
    allocated, budget = frame.pool.size("lists") // 4, frame.workspace.pair_budget
    size = enlarged(tile_range.pairs, budget) if 0 < allocated < tile_range.pairs else tile_range.pairs
    frame.scratch("lists", 4 * size)
    arguments = {"first_tile": tile_range.first, "end_tile": tile_range.end, "count": count}
    table = frame.named["bin table"]
    frame.launch(
        "bin", "bin_emit", (frame.config.sort_blocks,), (1,), frame.view_count, table=table, **arguments
    )


def _prefix_sums(
    frame: DeviceFrame, stage: str, table: cl.Buffer, bins: int, counter: int, lists: int
) -> cl.Buffer:
    """Prefix sums over tables of counts: the start of each bin (lists, bins of a list + 1). lists: 1 for a
    single list of all views, or the number of views. counter: index of the sum in the buffer `counters`."""
    views, items = frame.view_count, frame.config.scan_items
    totals = frame.scratch(f"{stage} totals", 4 * bins * views)
    list_bins = bins * views // lists
    starts = frame.scratch(f"{stage} starts", 4 * (list_bins + 1) * lists)
    frame.launch(stage, "scan_blocks", (bins,), (64,), views, table=table, bins=bins, totals=totals)
    scan = {"bins": list_bins, "totals": totals, "starts": starts, "counter": counter}
    frame.launch(stage, "scan_bins", (items,), (items,), lists, **scan)
    return starts


# with a small memory budget: project in slices, and store only the visible splats


class PackedCounts(NamedTuple):
    """Numbers of splats after the projection in slices, for a band of rows."""

    count: int
    """number of stored splats; an estimate if it exceeds `MemoryPlan.max_visible`"""
    visible: int
    """visible splats of the complete frame in the slices projected so far"""


def pack_visible(frame: DeviceFrame, top: int, end: int) -> PackedCounts:
    """Project in slices, and pack the visible splats of tile rows [top, end)."""
    height, plan = frame.config.tile_height, frame.plan
    frame.upload_view(top * height, end * height)
    big = 0
    while True:
        allocate_counters(frame, COUNTERS, big)
        sizes = {"splats": frame.source.records["Splat"].itemsize, "keys": KEY_BYTES, "windows": WINDOW_BYTES}
        packed = {
            name: frame.scratch(f"packed {name}", size * plan.max_visible) for name, size in sizes.items()
        }
        counts, big = _pack_slices(frame, packed)
        if big <= frame.scalars["big_capacity"]:
            break
        big *= 2
    if counts.count <= plan.max_visible:
        frame.named |= packed
    return counts


def _pack_slices(frame: DeviceFrame, packed: dict[str, cl.Buffer]) -> tuple[PackedCounts, int]:
    """Project and pack slices until a capacity is exceeded. Returns the packed splats, and the number of big
    splats if it exceeded the capacity, else 0."""
    count, size, blocks = frame.cloud.count, frame.plan.slice_size, frame.config.sort_blocks
    out: dict[str, Any] = {f"{name}_out": buffer for name, buffer in packed.items()}
    total = visible = 0
    for start in range(0, count, size):
        stop = min(start + size, count)
        project(frame, start, stop)
        frame.scratch("block_counts", 8 * blocks)
        frame.launch("project", "pack_count", (blocks,), (1,), count=stop - start)
        counts = frame.read("block_counts", np.uint32, (2, blocks)).astype(np.int64)
        visible += int(counts[1].sum())
        offsets = np.concatenate([[0], np.cumsum(counts[0])]) + total
        total = int(offsets[-1])
        if total > frame.plan.max_visible:
            return PackedCounts(-(-total * count // stop), visible), 0
        big = int(frame.read("counters", np.uint32, (COUNTERS,))[BIG])
        if big > frame.scalars["big_capacity"]:
            return PackedCounts(total, visible), big
        frame.upload("block_offsets", offsets[:-1].astype(np.uint32))
        frame.launch("project", "pack_move", (blocks,), (1,), count=stop - start, **out)
    return PackedCounts(total, visible), 0


def split_rows(frame: DeviceFrame, top: int, end: int, count: int) -> list[tuple[int, int]]:
    """Split tile rows [top, end) with `count` visible splats into bands that probably have at most
    `MemoryPlan.max_visible` each."""
    max_visible = frame.plan.max_visible
    if end - top == 1:
        raise DeviceError(
            f"the splats of a row of tiles must be at most {max_visible:,} within the memory budget, got "
            f"{count:,}; raise memory_budget or render fewer splats"
        )
    bands = min(max(2, -(-count * 11 // (10 * max_visible))), end - top)
    cuts = np.linspace(top, end, bands + 1).round().astype(int).tolist()
    return list(pairwise(cuts))


# on GPUs: append to tile lists, then sort each list


def pair_capacity(workspace: Workspace, config: KernelConfig) -> int:
    """Number of pairs that the allocated lists can hold."""
    pool = workspace.pool
    lists = pool.size("windows" if config.culls_first else "lists")
    return min(lists // 4, pool.size("pairs") // 8, workspace.pair_budget)


def project_and_count(frame: DeviceFrame, big: int = 0) -> None:
    """Project the cloud and count the pairs of each tile, with buffers for at least `big` big splats."""
    allocate_counters(frame, COUNTERS + frame.tiles, big)
    if frame.config.culls_first:
        cull(frame, big)
    project(frame, 0, frame.cloud.count)
    count = frame.records_per_view
    frame.launch("bin", "count_big", (_big_groups(frame) * _ITEMS,), (_ITEMS,), count=count)
    if frame.config.binning == "bin_local":
        launch_local(frame, "count_local")


def compute_list_starts(frame: DeviceFrame, capacity: int) -> cl.Event:
    """Compute the start of each tile's list; all lists are empty if there are more pairs than `capacity`."""
    items = frame.config.scan_items
    frame.scratch("starts", 4 * (frame.tiles + 1))
    frame.scratch("cursors", 4 * frame.tiles)
    frame.scratch("tile_order", 4 * frame.tiles)
    work_groups = 1 + min(-(-frame.tiles // _START_TILES), _MAX_START_GROUPS)
    arguments = {"tiles": frame.tiles, "capacity": capacity}
    return frame.launch("bin", "tile_starts", (work_groups * items,), (items,), **arguments)


def fill_and_sort_lists(
    frame: DeviceFrame, tile_range: TileRange, capacity: int, counts_visible: bool
) -> None:
    """Write the pairs of a range of tiles, and sort each list. counts_visible: whether to add up the number
    of visible splats, which the first range does."""
    frame.scratch("pairs", 8 * capacity)
    # with `culls_first` the lists reuse the buffer of the windows, which no kernel reads after `emit`
    reuses = frame.config.culls_first and not frame.in_tile_ranges
    frame.buffers.lists = frame.pool.scratch("windows" if reuses else "lists", 4 * capacity)
    count, views, work_groups = frame.records_per_view, frame.view_count, _big_groups(frame)
    arguments = {
        "first_tile": tile_range.first,
        "end_tile": tile_range.end,
        "capacity": capacity,
        "counts_visible": counts_visible,
    }
    if frame.config.binning == "bin_local":  # big splats, then all others
        frame.launch(
            "bin", "emit", (work_groups * _ITEMS,), (_ITEMS,), views, count=count, splat_groups=0, **arguments
        )
        launch_local(frame, "emit_local", **arguments)
    else:
        splat_groups = -(-count // _ITEMS)
        items = (splat_groups + -(-work_groups // views)) * _ITEMS
        frame.launch(
            "bin", "emit", (items,), (_ITEMS,), views, count=count, splat_groups=splat_groups, **arguments
        )
    arguments = {"first_tile": tile_range.first, "clear": not frame.waits}
    frame.launch(
        "sort", "sort_tiles", ((tile_range.end - tile_range.first) * _ITEMS,), (_ITEMS,), **arguments
    )


def launch_local(frame: DeviceFrame, kernel: str, **arguments: Any) -> None:
    """Submit a kernel of tile_lists_local.cl."""
    count, items = frame.cloud.count, frame.config.scan_items
    if count:
        work_groups = -(-count // _WORK_GROUP_SPLATS)
        frame.launch(
            "bin", kernel, (work_groups * items,), (items,), frame.view_count, count=count, **arguments
        )


def _big_groups(frame: DeviceFrame) -> int:
    """Number of work-groups for the splats that touch many tiles."""
    return 8 * frame.workspace.device.max_compute_units
