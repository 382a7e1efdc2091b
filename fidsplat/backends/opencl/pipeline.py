"""The stages compiled for one FeatureSet on one device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.opencl import tiling
from fidsplat.backends.opencl.assemble import KernelSource, assemble, culls_before_projection
from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.device_frame import DeviceFrame, Rendered
from fidsplat.backends.opencl.frame import render
from fidsplat.backends.opencl.images import OpenCLImages, acquire_images
from fidsplat.backends.opencl.kernel_config import KernelConfig
from fidsplat.backends.opencl.memory_plan import MemoryPlan, MemoryPlanner
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.recorded_frame import RecordedFrame, Replay
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import DeviceError

MIN_VECTORISED = 1 << 14
"""minimum splats of clouds whose projection is vectorised on CPUs"""
MIN_CULLED = 3 << 18
"""minimum splats of clouds that are sorted, and culled before projection; smaller ones gain nothing"""
_MAX_FRAMES = 32
"""maximum number of cached frames of a cloud"""
_MAX_RASTERS = 4
"""maximum number of lenses of cached frames: as many as `raster_of` caches"""


class OpenCLPipeline(Pipeline):
    """Stages compiled for one feature set; renders views and batches, and replays their command lists."""

    def __init__(
        self,
        workspace: Workspace,
        features: FeatureSet,
        config: KernelConfig,
        pipeline_for: Callable[[FeatureSet, KernelConfig], OpenCLPipeline],
    ) -> None:
        """pipeline_for: function that returns the pipeline with another config."""
        self.workspace, self.features, self.config = workspace, features, config
        self.outputs = {output.name: output for output in features.images}
        self._pipeline_for = pipeline_for
        self._variants: dict[tuple[tuple[str, Any], ...], OpenCLPipeline] = {}
        """pipelines with other build constants, by the changed constants"""

    @cached_property
    def source(self) -> KernelSource:
        """The text of the kernels, and their declarations."""
        return assemble(self.features, self.config)

    @cached_property
    def _planner(self) -> MemoryPlanner:
        return MemoryPlanner(self.workspace, self.source, self.features, self.config)

    @cached_property
    def program(self) -> Program:
        """The compiled kernels. Raises DeviceError if compilation fails."""
        return Program(self.workspace, self.source)

    @cached_property
    def _commands(self) -> CommandList:
        """Command list of frames that are not replayed."""
        return CommandList(self.program)

    def render_view(self, cloud: OpenCLCloud, view: View) -> OpenCLImages:
        """Choose the kernels for the cloud, then replay a recorded frame of this size and cloud, or else plan
        one and submit its stages (frame.py). On a GPU a replay does not wait.

        The first frame is planned, the second is also recorded, and later frames are replayed.
        """
        fastest = self._for_cloud(cloud)
        if fastest is not self:
            return fastest.render_view(cloud, view)
        with self.workspace.rendering():
            key = self._key(view)
            cached = cloud.cached_frames.get(key) if view.sample_rows is None else None
            if cached is not None and (images := self._replay(cloud, view, cached)) is not None:
                return images
            plan = self._planner.plan_frame(cloud, view)
            if plan.slice_size and self.config.binning != "sort_first":
                return self._in_slices().render_view(cloud, view)
            frame = self._render_frame(cloud, view, plan)
            complete = not (plan.slice_size or frame.in_tile_ranges or view.sub_frames or view.sample_rows)
            if complete and cloud.count and not cloud.streamed:
                self._cache(cloud, key, plan)
            return OpenCLImages(self, view, [frame.rendered()], cloud.count)

    def render(self, cloud: OpenCLCloud, batch: ViewBatch) -> OpenCLImages:
        """Plan and render a batch, in sub-batches of as many views as fit the memory budget."""
        if batch.is_single:
            return self.render_view(cloud, batch.view_at(0))
        if self._is_too_small_to_vectorise(cloud):
            return self._with(splats_per_item=1).render(cloud, batch)
        workspace, rendered = self.workspace, []
        with workspace.rendering():
            workspace.switch_to(workspace.queue)
            acquired = acquire_images(workspace, self.features.images, batch)
            images = {f"{name}_out": buffer for name, (_, buffer) in zip(self.outputs, acquired, strict=True)}
            for first, end, plan in self._planner.plan_batch(cloud, batch):
                sub_batch = batch.sub_batch(first, end)
                pipeline = self._for_sub_batch(cloud, plan, sub_batch)
                size_key = pipeline, "views", cloud.padded_count, plan
                workspace.pool.trim(size_key, workspace.memory_budget - plan.total)
                frame = DeviceFrame(workspace, pipeline._commands, pipeline.config, cloud, sub_batch, plan)
                frame.named |= images  # of the complete batch, of which these views fill a part
                render(frame)
                rendered.append(frame.rendered())
            return OpenCLImages(self, batch, rendered, cloud.count, acquired)

    def fits(self, cloud: OpenCLCloud, view: View) -> bool:
        try:
            return not self._planner.plan_frame(cloud, view).slice_size
        except DeviceError:  # too little memory even for a divided frame
            return False

    def render_undivided(self, cloud: OpenCLCloud, view: View) -> DeviceFrame:
        """Render one frame without slices and ranges of tiles; returns its buffers, valid until the next
        frame. Raises DeviceError if it exceeds the memory budget."""
        if self._is_too_small_to_vectorise(cloud):
            return self._with(splats_per_item=1).render_undivided(cloud, view)
        with self.workspace.rendering():
            plan, frame = self._planner.plan_frame(cloud, view), None
            if not plan.slice_size:
                frame = self._render_frame(cloud, view, plan)
            if frame is None or frame.pairs > self.workspace.pair_budget:
                raise DeviceError(
                    "frames with derivatives must fit the memory budget without slices or ranges of tiles, "
                    f"got {cloud.count:,} splats; raise memory_budget, or use fewer splats or pixels"
                )
            return frame

    def replay_undivided(self, cloud: OpenCLCloud, view: View, pair_limit: int) -> DeviceFrame:
        """Render one frame like `render_undivided` without waiting for its counts, which
        `DeviceFrame.count_pairs` reads later; replayed if possible. pair_limit: maximum capacity of the
        lists."""
        if self.config.binning == "sort_first" or not cloud.count:
            return self.render_undivided(cloud, view)
        workspace, key = self.workspace, (*self._key(view), pair_limit)
        with workspace.rendering():
            recorded, queue = cloud.cached_frames.get(key), workspace.switch_to(workspace.queue)
            if recorded is not None and recorded.set_view(view, queue):
                frame = DeviceFrame(
                    *(workspace, recorded.commands, self.config, cloud),
                    *(ViewBatch.single(view), recorded.plan, queue, pair_limit),
                )
                recorded.replay_into(frame)
                frame.recorded = recorded
                return frame
            plan = self._planner.plan_frame(cloud, view)
            self._trim(cloud, view, plan)
            if plan.slice_size or not tiling.pair_capacity(workspace, self.config):
                return self.render_undivided(cloud, view)
            if recorded is None:
                recorded = cloud.cached_frames[key] = RecordedFrame(plan, CommandList(self.program))
            frame = self._record(cloud, view, plan, recorded, queue, pair_limit)
            frame.recorded = recorded
            return frame

    def images_of(self, frame: DeviceFrame) -> OpenCLImages:
        """The images of a frame that was not divided."""
        return OpenCLImages(self, frame.view, [frame.rendered()], frame.cloud.count)

    def render_again(self, cloud: OpenCLCloud, view: View) -> Rendered:
        """Render a frame with larger buffers, after its replay exceeded the capacity."""
        with self.workspace.rendering():
            return self._render_frame(cloud, view, self._planner.plan_frame(cloud, view)).rendered()

    def _replay(self, cloud: OpenCLCloud, view: View, recorded: RecordedFrame) -> OpenCLImages | None:
        """Replay a cached frame for another view; None if its buffers are too small or were replaced."""
        workspace, waits = self.workspace, self.config.binning == "sort_first"
        self._trim(cloud, view, recorded.plan)
        if not waits and not tiling.pair_capacity(workspace, self.config):
            return None
        queue = workspace.switch_to(workspace.queue if waits else workspace.replay_queue)
        if recorded.set_view(view, queue):
            workspace.frames += 1
            rendered = recorded.submit(queue, cloud.count)
            if rendered is None:
                return None
        else:
            rendered = self._record(cloud, view, recorded.plan, recorded, queue).rendered()
        if waits:
            return OpenCLImages(self, view, [rendered], cloud.count)
        replay = Replay(recorded, cloud, view, self.render_again)
        images = OpenCLImages(self, view, [rendered], cloud.count, replay=replay)
        if not cloud.immutable:
            images.ensure_complete()
        return images

    def _record(
        self,
        cloud: OpenCLCloud,
        view: View,
        plan: MemoryPlan,
        recorded: RecordedFrame,
        queue: cl.CommandQueue,
        pair_limit: int = 0,
    ) -> DeviceFrame:
        """Render one frame, and record its launches unless it was rendered in ranges of tiles."""
        recorded.generation = None  # after an interrupt the command list may be incomplete
        frame = self._render_frame(cloud, view, plan, recorded.commands, queue, pair_limit)
        if not frame.in_tile_ranges:
            recorded.record(frame)
        return frame

    def _render_frame(
        self,
        cloud: OpenCLCloud,
        view: View,
        plan: MemoryPlan,
        commands: CommandList | None = None,
        replay_queue: cl.CommandQueue | None = None,
        pair_limit: int = 0,
    ) -> DeviceFrame:
        """Submit all stages of one frame. commands, replay_queue, pair_limit: see `DeviceFrame`."""
        self._trim(cloud, view, plan)
        frame = DeviceFrame(
            *(self.workspace, commands or self._commands, self.config),
            *(cloud, ViewBatch.single(view), plan, replay_queue, pair_limit),
        )
        frame.acquire_images(self.features.images)
        render(frame)
        return frame

    def _trim(self, cloud: OpenCLCloud, view: View, plan: MemoryPlan) -> None:
        """Release the buffers of frames with other sizes; buffers of this size are part of the plan."""
        shared = cloud.buffer_key if not plan.slice_size else None
        size_key = self, view.width, view.height, shared or (cloud.padded_count, plan)
        self.workspace.pool.trim(size_key, self.workspace.memory_budget - plan.total, cloud.padded_count)

    def _cache(self, cloud: OpenCLCloud, key: tuple[Any, ...], plan: MemoryPlan) -> None:
        """Cache the plan of a frame; the next frame with this key is recorded."""
        cached = cloud.cached_frames
        rasters = {raster for _, _, _, raster, *_ in cached} | {key[3]}
        if len(cached) >= _MAX_FRAMES or len(rasters - {None}) > _MAX_RASTERS:
            cached.clear()
        cached[key] = RecordedFrame(plan, CommandList(self.program))

    def _key(self, view: View) -> tuple[Any, ...]:
        """Key of a command list: frames with the same key differ only in numeric arguments."""
        labels, budgets = tuple(dict(view.groups)), (self.workspace.memory_budget, self.workspace.pair_budget)
        return self, view.width, view.height, view.raster, labels, budgets

    def _for_cloud(self, cloud: OpenCLCloud) -> OpenCLPipeline:
        """The pipeline with the fastest projection and tile binning for a cloud."""
        if self._is_too_small_to_vectorise(cloud):
            return self._with(splats_per_item=1)
        if self.config.binning != "bin_first" or self.config.culls_first:
            return self
        if cloud.is_spatially_sorted:
            return self._with(binning="bin_local")
        if cloud.count >= MIN_CULLED and cloud.sortable and self._can_cull:
            return self._with(culls_first=True)
        return self

    def _for_sub_batch(self, cloud: OpenCLCloud, plan: MemoryPlan, batch: ViewBatch) -> OpenCLPipeline:
        """The pipeline with the fastest tile binning for a sub-batch."""
        if self.config.binning != "bin_first":
            return self
        if plan.slice_size:
            return self._in_slices()
        few = len(batch) > 1 and self._planner.tiles(batch.view) <= tiling.LOCAL_TILES
        return self._with(binning="bin_local") if few or cloud.is_spatially_sorted else self

    def _in_slices(self) -> OpenCLPipeline:
        """The pipeline for projection in slices, with the only tile binning that supports it."""
        return self._with(binning="sort_first", culls_first=False)

    def _with(self, **constants: Any) -> OpenCLPipeline:
        """The pipeline with other build constants."""
        key = tuple(constants.items())
        if key not in self._variants:
            self._variants[key] = self._pipeline_for(self.features, replace(self.config, **constants))
        return self._variants[key]

    def _is_too_small_to_vectorise(self, cloud: OpenCLCloud) -> bool:
        """Whether compiling the vectorised projection would take longer than it saves, for a small cloud."""
        return self.config.splats_per_item > 1 and cloud.count < MIN_VECTORISED

    @cached_property
    def _can_cull(self) -> bool:
        return culls_before_projection(self.features)

    def render_intermediates(self, cloud: OpenCLCloud, view: View) -> dict[str, np.ndarray]:
        """Render one view; returns the buffers between the stages: keys (n,) uint32; starts (tiles + 1,)
        uint32; lists (pairs,) uint32, of the last range of tiles; records (n,) of the struct `Splat`; raw (4,
        rows, columns) float32: r, g, b, transmittance, unless they stay in registers; output images by
        name."""
        with self.workspace.rendering():
            frame = self._render_frame(cloud, view, MemoryPlan(0, cloud.count, 0))
        images, raw = self.images_of(frame), {}
        if "raw" in self.source.arguments["blend"]:
            raw["raw"] = frame.read("raw", np.float32, (4, frame.rows, frame.stride))
        return raw | {
            "keys": frame.read("keys", np.uint32, (cloud.count,)),
            "starts": frame.read("starts", np.uint32, (frame.tiles + 1,)),
            "lists": frame.read("lists", np.uint32, (images.stats["pairs"],)),
            "records": frame.read("splats", self.source.records["Splat"], (cloud.count,)),
            **{output.name: images.read(output.name, 0) for output in self.features.images},
        }
