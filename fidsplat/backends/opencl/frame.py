"""The stages of a frame in order: project, bin and sort, blend, resolve; a CPU sorts before it bins.

They are submitted to one in-order queue. A frame with more pairs than the memory budget allows is binned and
blended in ranges of tiles. A frame with a shutter is blended pose by pose and resolved once. Images are
bit-identical in every case.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl import tiling
from fidsplat.backends.opencl.counts import COUNTERS, COUNTS, read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.tiling import TileRange
from fidsplat.backends.view import SubFrame

_GRID = (16, 4)
"""work-group of kernels over pixels or samples"""
_UNLIMITED = 2**32 - 1
_NO_DEPTH = np.full(1, 0xFFFFFFFF, np.uint32)
"""termination depth of tiles that are not rendered"""


def render(frame: DeviceFrame) -> None:
    """Submit all stages of a frame whose images are bound."""
    if frame.view.sub_frames:
        render_sub_frames(frame)
        return
    frame.discard_launches()
    allocate_samples(frame)
    if frame.plan.slice_size:
        render_in_slices(frame)
    elif frame.config.binning == "sort_first":
        render_sort_first(frame)
    else:
        render_bin_first(frame)


def allocate_samples(frame: DeviceFrame) -> None:
    """Bind the buffers that the blend stage writes."""
    for samples in frame.sample_buffers:
        if samples.name in frame.source.arguments["blend"]:
            frame.scratch(samples.name, 4 * frame.scalars["channel_stride"] * samples.channels)
    if "termination_depths" in frame.source.arguments["blend"]:
        depths = frame.acquire("termination_depths", 4 * frame.tiles)
        if frame.view.sample_rows is not None:
            cl.enqueue_fill_buffer(frame.queue, depths, _NO_DEPTH, 0, 4 * frame.tiles)


def render_sort_first(frame: DeviceFrame) -> None:
    """Render on a CPU: wait for the number of pairs, then allocate the lists."""
    count, big = frame.cloud.count, 0
    frame.upload_view(0, frame.rows)
    while True:
        tiling.allocate_counters(frame, COUNTERS * frame.view_count, big)
        tiling.project(frame, 0, count)
        tiling.sort_by_depth(frame, count)
        counts = tiling.count_pairs(frame, count)
        if counts.big <= frame.scalars["big_capacity"]:
            break
        big = counts.big
        frame.discard_launches()
    for tile_range in tiling.tile_ranges(frame, frame.first_tile, frame.end_tile, counts.pairs):
        tiling.fill_sorted_lists(frame, tile_range, count)
        blend(frame, tile_range)
    resolve(frame)
    frame.pairs, frame.stats = counts.pairs, partial(counts.stats, count)


def render_bin_first(frame: DeviceFrame) -> None:
    """Render on a GPU: submit all stages with the list capacity of previous frames, and again with larger
    lists if the pairs exceed it."""
    frame.upload_view(0, frame.rows)
    frame.acquire("frame_counts", 4 * COUNTS)
    capacity = tiling.pair_capacity(frame.workspace, frame.config)
    if frame.pair_limit:
        capacity = min(capacity, frame.pair_limit)
    tiling.project_and_count(frame)
    counted = tiling.compute_list_starts(frame, capacity)
    frame.launches_until_counts = len(frame.events)
    if capacity:
        all_tiles = TileRange(0, frame.tiles, capacity)
        tiling.fill_and_sort_lists(frame, all_tiles, capacity, counts_visible=True)
        blend(frame, all_tiles)
        resolve(frame)
    if frame.waits:
        complete_bin_first(frame, counted, capacity)
    else:
        frame.counted, frame.pairs = counted, capacity
    frame.queue.flush()
    reader, last, count = frame.workspace.read_queue, frame.events[-1], frame.cloud.count
    frame.stats = partial(read_stats, reader, frame.buffers.frame_counts, last, count)


def complete_bin_first(frame: DeviceFrame, counted: cl.Event, capacity: int) -> None:
    """Wait for the counts; if they exceed `capacity`, render again with larger buffers."""
    counts = frame.read_counts(counted)
    while counts.big > frame.scalars["big_capacity"]:
        tiling.project_and_count(frame, counts.big)
        counted, capacity = tiling.compute_list_starts(frame, 0), 0
        counts = frame.read_counts(counted)
    frame.pairs = counts.pairs
    if capacity and counts.pairs <= capacity:
        return
    tiling.compute_list_starts(frame, _UNLIMITED)
    tile_ranges = tiling.tile_ranges(frame, 0, frame.tiles, counts.pairs)
    with_margin = min(counts.pairs * 5 // 4, frame.workspace.pair_budget)
    capacity = max(with_margin, *(tile_range.pairs for tile_range in tile_ranges))
    for tile_range in tile_ranges:
        tiling.fill_and_sort_lists(frame, tile_range, capacity, counts_visible=tile_range is tile_ranges[0])
        blend(frame, tile_range)
    resolve(frame)


def render_in_slices(frame: DeviceFrame) -> None:
    """Render with a small memory budget: project the cloud in slices, and store only visible splats; if these
    exceed the capacity, project again for each band of tile rows."""
    rows = [(frame.first_tile // frame.tiles_x, frame.end_tile // frame.tiles_x)]
    visible = pairs = 0
    while rows:
        top, end = rows.pop(0)
        packed = tiling.pack_visible(frame, top, end)
        if packed.count > frame.plan.max_visible:
            rows = tiling.split_rows(frame, top, end, packed.count) + rows
            continue
        tiling.sort_by_depth(frame, packed.count)
        tiling.count_pairs(frame, packed.count)
        first, last = top * frame.tiles_x, end * frame.tiles_x
        listed = int(tiling.tile_pairs(frame)[first:last].sum(dtype=np.int64))
        for tile_range in tiling.tile_ranges(frame, first, last, listed):
            tiling.fill_sorted_lists(frame, tile_range, packed.count)
            blend(frame, tile_range)
        visible, pairs = max(visible, packed.visible), pairs + listed
    resolve(frame)
    frame.stats = partial(dict, splats=frame.cloud.count, visible=visible, pairs=pairs)


def blend(frame: DeviceFrame, tile_range: TileRange) -> None:
    """Submit the blend kernel for a range of tiles; GPUs start with the longest lists."""
    local_size = frame.config.blend_items
    arguments: dict[str, Any] = {"first_tile": tile_range.first}
    if frame.config.schedule == "group":
        ordered = frame.config.binning != "sort_first" and tile_range.end - tile_range.first == frame.tiles
        # every pointer argument needs a buffer; the kernel reads `tile_order` only if `longest_first`
        arguments["tile_order"] = frame.named["tile_order"] if ordered else frame.buffers.starts
        arguments["longest_first"] = ordered
    frame.launch(
        "blend", "blend", ((tile_range.end - tile_range.first) * local_size,), (local_size,), **arguments
    )


def resolve(frame: DeviceFrame) -> None:
    """Composite the background behind the splats and average samples to pixels, unless fused into `blend`."""
    arguments, view = frame.source.arguments, frame.view
    if "composite_background" in arguments and not view.sub_frames:
        _launch_grid(frame, "resolve", "composite_background", view.width, view.height)
    if "resolve" in arguments and not frame.is_sub_frame:
        _launch_grid(frame, "resolve", "resolve", view.width // view.samples, view.height // view.samples)


def _launch_grid(
    frame: DeviceFrame, stage: str, kernel: str, width: int, height: int, **arguments: Any
) -> None:
    """Submit a kernel with a work-item for each pixel or sample of each view."""
    frame.launch(
        stage, kernel, (width, height), _GRID, frame.view_count, width=width, height=height, **arguments
    )


def render_sub_frames(frame: DeviceFrame) -> None:
    """Blend the sub-frames of a shutter one after another, and resolve their mean."""
    for samples in frame.sample_buffers:
        size = 4 * frame.rows * frame.stride * samples.channels
        frame.named[samples.name] = frame.pool.scratch(f"accumulated {samples.name}", size)
    background_arrays = {
        name: frame.upload(name, frame.view.array(name))
        for name, argument in frame.source.arguments.get("composite_background", {}).items()
        if argument.source == "array"
    }
    stats = {"splats": frame.cloud.count, "visible": 0, "pairs": 0}
    for sub_frame in frame.view.sub_frames:
        blended = frame.sub_frame(sub_frame.view)
        blended.named |= background_arrays
        render(blended)
        frame.events += blended.events
        frame.stages += blended.stages
        accumulate(frame, blended, sub_frame)
        for name, value in blended.stats().items():
            stats[name] = max(stats[name], value)
        frame.uploads += blended.uploads
        frame.pool.release(blended.acquired.items())
    if "rays" in frame.source.arguments.get("resolve", {}):
        frame.bind_rays()
    frame.upload("batch_indices", frame.batch.batch_indices)  # sub-frames have overwritten this buffer
    resolve(frame)
    frame.stats = partial(dict, stats)


def accumulate(frame: DeviceFrame, blended: DeviceFrame, sub_frame: SubFrame) -> None:
    """Add the samples of a blended sub-frame to those of the frame."""
    size = sub_frame.view.width, sub_frame.view.height
    for samples in frame.sample_buffers:
        if not (samples.averaged or sub_frame.middle):
            continue
        arguments: dict[str, Any] = {
            "stride": blended.stride,
            "channel_stride": blended.rows * blended.stride,
            "frame_stride": frame.stride,
            "frame_channel_stride": frame.rows * frame.stride,
            "top": sub_frame.top,
            "channels": samples.channels,
            "raw": blended.named[samples.name],
            "accumulated": frame.named[samples.name],
        }
        if samples.averaged:
            weights = {"weight": sub_frame.weight, "first": sub_frame.first}
            _launch_grid(frame, "accumulate", "accumulate", *size, **arguments, **weights)
        else:
            _launch_grid(frame, "accumulate", "copy_middle", *size, **arguments)
