"""State of one frame on the device: buffers, kernel arguments and launches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.counts import Capacity, Counts
from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.backends.opencl.kernel_interface import RAW
from fidsplat.backends.opencl.memory_plan import MemoryPlan
from fidsplat.backends.opencl.uniforms import array_arguments, scalar_arguments
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.effects.catalogue import Output


class FrameBuffers:
    """Buffers of every frame, named like the kernel arguments; each is set by the stage that allocates it.

    v views, n splats, t tiles and s samples of all views.
    """

    view: cl.Buffer
    """records `View` (groups + 1, v)"""
    moving: cl.Buffer
    """number of moving groups of splats, then the label of each group"""
    splats: cl.Buffer
    """records `Splat` (v, n)"""
    keys: cl.Buffer
    """sort keys by depth (v, n) uint32; two values above all depths mark culled splats (prelude.cl)"""
    windows: cl.Buffer
    """tiles that a splat overlaps (v, n) uint2: a bit mask of 8 x 4 tiles at most, or its index in `big`"""
    counters: cl.Buffer
    """totals of the frame, then the length of each tile's list (COUNTERS + t) uint32; totals of each view
    (v, COUNTERS) with `sort_first`"""
    big: cl.Buffer
    """splats whose tiles do not fit into a window (big_capacity) uint32"""
    big_bounds: cl.Buffer
    """records `Bounds` (big_capacity)"""
    order: cl.Buffer
    """splats by depth (v, n) uint32"""
    starts: cl.Buffer
    """start of each tile's list (t + 1) uint32"""
    cursors: cl.Buffer
    """next free position in each tile's list (t) uint32"""
    pairs: cl.Buffer
    """unsorted lists: depth key and splat (capacity) uint2"""
    lists: cl.Buffer
    """splats of each tile in depth order (capacity) uint32"""
    frame_counts: cl.Buffer
    """totals that the host reads (`Counts`)"""
    raw: cl.Buffer
    """samples (4, s) float32: r, g, b, transmittance"""
    batch_indices: cl.Buffer
    """index of each view in the output images (v) uint32"""
    termination_depths: cl.Buffer
    """depth key at which each tile was terminated (t) uint32"""


@dataclass
class Rendered:
    """Buffers and events of a submitted frame, without references to the cloud and scratch buffers."""

    queue: cl.CommandQueue
    acquired: dict[str, cl.Buffer]
    """output images and counts by name"""
    stats: Callable[[], dict[str, int]]
    events: list[cl.Event]
    """events of the launches"""
    stages: list[str] | None = None
    """stage of each launch; None on a queue without profiling"""
    uploads: list[cl.Event] | None = None
    """keeps the cloud's arrays alive until the device has read them"""

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage; empty without profiling."""
        self.queue.finish()
        timings: dict[str, float] = {}
        for stage, event in zip(self.stages or (), self.events, strict=False):
            timings[stage] = timings.get(stage, 0.0) + (event.profile.end - event.profile.start) * 1e-6
        return timings


class DeviceFrame:
    """State of a frame, or of several views rendered together, while its stages are submitted."""

    def __init__(
        self,
        workspace: Workspace,
        commands: CommandList,
        config: KernelConfig,
        cloud: OpenCLCloud,
        batch: ViewBatch,
        plan: MemoryPlan,
        replay_queue: cl.CommandQueue | None = None,
        pair_limit: int = 0,
    ) -> None:
        """commands: records the launches. replay_queue: queue of frames that are recorded for replay; on a
        GPU the host does not wait for their counts. pair_limit: largest capacity of the lists of a recorded
        frame; 0: no limit."""
        self.workspace, self.commands, self.config = workspace, commands, config
        self.cloud, self.plan = cloud, plan
        self.records_per_view = cloud.count
        """records per view: the number of splats, or with `culls_first` the capacity for unculled splats"""
        self.batch, self.view_count = batch, len(batch)
        self.view = view = batch.view
        self.waits = replay_queue is None or config.binning == "sort_first"
        """whether the host waits for the counts"""
        self.pair_limit, self.pool = pair_limit, workspace.pool
        self.queue = workspace.switch_to(workspace.queue) if replay_queue is None else replay_queue
        self.source = commands.program.source
        """arguments of the program whose kernels are launched"""
        workspace.frames += 1
        self.tiles_x = -(-view.width // config.tile_width)
        self.tiles_y = -(-view.height // config.tile_height)
        self.tiles = self.view_count * self.tiles_x * self.tiles_y
        """number of tiles of all views; the tiles of a view are consecutive"""
        self.stride = self.tiles_x * config.tile_width
        self.rows = self.tiles_y * config.tile_height
        self.first_tile, self.end_tile = 0, self.tiles
        """tiles of the requested rows"""
        if view.sample_rows is not None and config.binning == "sort_first" and self.view_count == 1:
            self.first_tile = view.sample_rows[0] // config.tile_height * self.tiles_x
            self.end_tile = -(-view.sample_rows[1] // config.tile_height) * self.tiles_x
        self.buffers = FrameBuffers()
        self.named: dict[str, cl.Buffer] = vars(self.buffers)
        """all buffers, including those of effects and outputs, by the names of the kernel arguments"""
        self.scalars: dict[str, Any] = scalar_arguments(view, self.source)
        """scalar kernel arguments by name"""
        self.scalars |= {"width": view.width, "height": view.height, "stride": self.stride}
        self.scalars["channel_stride"] = self.view_count * self.rows * self.stride
        self.sample_buffers = RAW, *self.source.sample_buffers
        """sample buffers, which the blend stage writes"""
        self.is_sub_frame = False
        """whether this is one pose of a frame with a shutter; the complete frame resolves its samples"""
        self.events: list[cl.Event] = []
        self.stages: list[str] = []
        """stage of each launch"""
        self.arrays: dict[str, np.ndarray | DeviceRecord] = {}
        """host arrays and records copied for this view"""
        self.uploads: list[cl.Event] = []
        """events of copies to the device"""
        self.acquired: dict[str, cl.Buffer] = {}
        self.launches_until_counts = 0
        """number of launches after which the counts are complete"""
        self.counted: cl.Event | None = None
        """event after which the pairs are counted, if the host did not wait"""
        self.recorded: Any = None
        """the RecordedFrame that replays it, if there is one"""
        self.in_tile_ranges = False
        """whether the lists exceeded the pair budget, so that the frame was rendered in ranges of tiles"""
        self.pairs = 0
        """number of listed pairs; the capacity of the lists if the host did not wait"""
        self.stats: Callable[[], dict[str, int]] = dict

    def sub_frame(self, view: View) -> DeviceFrame:
        """The frame of `view`, one of the camera poses that a shutter averages."""
        batch = ViewBatch.single(view)
        frame = DeviceFrame(self.workspace, self.commands, self.config, self.cloud, batch, self.plan)
        frame.is_sub_frame = True
        return frame

    @property
    def capacity(self) -> Capacity:
        return Capacity(self.scalars["big_capacity"], self.pairs)

    def count_pairs(self) -> int | None:
        """Wait for the number of pairs; None if it exceeded the capacity, so that the frame is empty."""
        if self.counted is None:
            return self.pairs
        counts = self.read_counts(self.counted)
        return counts.pairs if self.capacity.holds(counts) else None

    def read_counts(self, counted: cl.Event) -> Counts:
        """Read the counts after the launch `counted`, while later stages run."""
        self.queue.flush()
        return Counts.read(self.workspace.side_queue, self.buffers.frame_counts, [counted])

    def launch(
        self,
        stage: str,
        kernel: str,
        items: tuple[int, ...],
        local_size: tuple[int, ...],
        view_count: int = 1,
        **arguments: Any,
    ) -> cl.Event:
        """Submit a kernel with at least `items` work-items per view. arguments: values by name,
        for arguments that the frame does not define."""
        size = tuple([-(-count // side) * side for count, side in zip(items, local_size, strict=True)])
        if view_count > 1:
            size, local_size = (*size, view_count), (*local_size, 1)
        values = [
            arguments[name] if name in arguments else self.argument_value(declared)
            for name, declared in self.source.arguments[kernel].items()
        ]
        event = self.commands.launch(self.queue, kernel, size, local_size, values, stage)
        self.events.append(event)
        self.stages.append(stage)
        return event

    def discard_launches(self) -> None:
        """Discard all recorded launches, to start the frame again."""
        self.commands.clear()
        self.events, self.stages = [], []

    def argument_value(self, argument: Argument) -> Any:
        """A buffer or number of the frame; an array of the view is uploaded."""
        name = argument.name
        for values in (self.named, self.scalars):
            if name in values:
                return values[name]
        if argument.source == "uniform":  # of the backward pass; others are in `scalars`
            uniform_group, index = argument.uniform
            return self.view.uniforms_of(uniform_group)[index]
        return self.upload(name, self.view.array(name))

    def scratch(self, name: str, size: int) -> cl.Buffer:
        """Bind a scratch buffer; the next frame overwrites it."""
        buffer = self.named[name] = self.pool.scratch(name, size)
        return buffer

    def acquire(self, name: str, size: int) -> cl.Buffer:
        """Bind a buffer that belongs to the frame until its images are released."""
        buffer = self.acquired[name] = self.named[name] = self.pool.acquire(name, size)
        return buffer

    def upload(self, name: str, array: np.ndarray | DeviceRecord) -> cl.Buffer:
        """Bind a scratch buffer with these contents; does not wait."""
        self.arrays[name] = array
        buffer, event = self.pool.upload(self.queue, name, array)
        if event is not None:
            self.uploads.append(event)
        self.named[name] = buffer
        return buffer

    def read(self, name: str, dtype: Any, shape: tuple[int, ...]) -> np.ndarray:
        array = np.empty(shape, dtype)
        if array.size:
            cl.enqueue_copy(self.queue, array, self.named[name])
        return array

    def acquire_images(self, outputs: tuple[Output, ...]) -> None:
        """Bind buffers for the output images of one view."""
        view = self.view
        pixels = (view.height // view.samples) * (view.width // view.samples)
        for output in outputs:
            self.acquire(f"{output.name}_out", 4 * pixels * output.channels)

    def upload_view(self, row: int, end: int) -> None:
        """Copy the arrays of the views to the device, for rows of samples [row, end)."""
        if self.view.raster is not None:
            self.bind_rays()
        for name, array in array_arguments(self.batch, self.source, row, end).items():
            self.upload(name, array)

    def rendered(self) -> Rendered:
        stages = None if self.queue is self.workspace.replay_queue else self.stages
        return Rendered(self.queue, self.acquired, self.stats, self.events, stages, self.uploads)

    def bind_rays(self) -> None:
        """Bind the rays of a lens, and its inverse lookup table."""
        assert self.view.raster is not None
        with_derivatives = "ray_derivatives" in self.source.arguments["blend"]
        self.named |= self.workspace.ray_buffers.of(
            self.view.raster, self.rows, self.stride, with_derivatives
        )
