"""The stages compiled for one FeatureSet on one device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.opencl import tiling
from fidsplat.backends.opencl.assemble import Source
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.counts import read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.frame import render
from fidsplat.backends.opencl.images import OpenCLImages, Rendered, Replay, lease_images
from fidsplat.backends.opencl.memory_plan import MemoryPlan, MemoryPlanner
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.recorded_frame import RecordedFrame
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.view import View
from fidsplat.cameras.raster import RayRaster
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import DeviceError

_KINDS = 32
"""kinds of frames that are cached for a cloud"""
_RASTERS = 4
"""lenses among them: as many as `raster_of` caches"""


@dataclass
class CachedFrame:
    """A kind of frame that was rendered before, for a cloud."""

    plan: MemoryPlan
    kind: tuple[Any, ...]
    """for `BufferPool.make_way`"""
    raster: RayRaster | None
    """of the lens, whose rays stay on the device as long"""
    recorded: RecordedFrame | None = None


class OpenCLPipeline(Pipeline):
    """Compiled stages."""

    def __init__(
        self,
        workspace: Workspace,
        source: Source,
        features: FeatureSet,
        shape: DeviceShape,
        other: Callable[[FeatureSet, DeviceShape], OpenCLPipeline],
    ) -> None:
        """other: returns the pipeline of another shape."""
        self.workspace, self.source, self.features, self.shape = workspace, source, features, shape
        self.program = Program(workspace, source)
        self._commands = CommandList(self.program)
        """of frames that are not replayed"""
        self._planner = MemoryPlanner(workspace, source, features, shape)
        self._other = other

    def render_view(self, resident: Resident, view: View) -> OpenCLImages:
        """Render one view. A frame of a kind that was rendered before is replayed, without waiting for the
        device.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.rendering():
            return self._render_single(resident, ViewBatch.single(view))

    def render(self, resident: Resident, views: ViewBatch) -> OpenCLImages:
        """Render views, as many at once as memory holds. Raises DeviceError as `render_view`."""
        if views.is_single:
            return self.render_view(resident, views.one(0))
        with self.workspace.rendering():
            return self._render_parts(resident, views)

    def _render_single(self, resident: Resident, views: ViewBatch) -> OpenCLImages:
        view = views.view
        key = self._key(view) if view.band is None else None
        cached = resident.cached_frames.get(key)
        if cached is not None and (images := self._replay(resident, views, cached)) is not None:
            return images
        if resident.coherent and self.shape.lists == "tiled":
            return self._listing("local").render(resident, views)
        plan = self._planner.frame(resident, view)
        if plan.chunk and self.shape.lists != "ordered":
            # chunks are rendered by one strategy only: where memory is short, sorting is fastest
            return self._listing("ordered").render(resident, views)
        frame = self._render_planned(resident, view, plan)
        if key is not None and self._is_replayable(frame):
            self._cache(resident, key, frame)
        return self.images_of(frame)

    def _render_parts(self, resident: Resident, views: ViewBatch) -> OpenCLImages:
        workspace, rendered = self.workspace, []
        workspace.switch_to(workspace.queue)
        leased = lease_images(workspace, self.features.images, views)
        names = [f"{output.name}_out" for output in self.features.images]
        images = dict(zip(names, (buffer for _, buffer in leased), strict=True))
        for first, end, plan in self._planner.parts(resident, views):
            part = views.part(first, end)
            pipeline = self._for_part(resident, plan, part)
            kind = pipeline, "views", resident.capacity, plan
            workspace.pool.make_way(kind, workspace.memory_budget - plan.held)
            frame = DeviceFrame(workspace, pipeline._commands, pipeline.shape, resident, part, plan)
            frame.bind_images(images)
            render(frame)
            rendered.append(Rendered.of(frame))
        return self._images(views, rendered, resident, leased)

    def fits(self, resident: Resident, view: View) -> bool:
        """Whether the frame is rendered at once; otherwise the cloud is projected for each of its parts."""
        try:
            return not self._planner.frame(resident, view).chunk
        except DeviceError:  # too little memory for any part of it
            return False

    def render_complete(self, resident: Resident, view: View) -> DeviceFrame:
        """One frame with all that its stages leave on the device until the next frame.

        Raises:
            DeviceError: as `render`; or the frame does not fit the memory budget at once.
        """
        with self.workspace.rendering():
            plan, frame = self._planner.frame(resident, view), None
            if not plan.chunk:
                frame = self._render_planned(resident, view, plan)
            if frame is None or frame.pairs > self.workspace.pair_budget:
                raise DeviceError(
                    "frames with derivatives must fit the memory budget without chunks or bands, got "
                    f"{resident.count:,} splats; raise memory_budget, or use fewer splats or smaller frames"
                )
            return frame

    def replay_complete(self, resident: Resident, view: View, pair_limit: int) -> DeviceFrame:
        """`render_complete` without waiting for the counts: `DeviceFrame.count_pairs` returns whether the
        buffers sufficed. A frame of a kind that was rendered before is replayed.

        pair_limit: largest capacity of the lists.
        """
        if self.shape.lists == "ordered" or not resident.count:
            return self.render_complete(resident, view)
        workspace, key = self.workspace, (*self._key(view), pair_limit)
        with workspace.rendering():
            cached, queue = resident.cached_frames.get(key), workspace.switch_to(workspace.queue)
            recorded = None if cached is None else cached.recorded
            if cached is not None and recorded is not None and self._ready(recorded, resident, view, queue):
                frame = self._frame(resident, view, cached.plan, recorded.commands, queue, pair_limit)
                recorded.render(frame)
                return frame
            plan = self._planner.frame(resident, view)
            kind = self._buffer_kind(resident, view, plan)
            workspace.pool.make_way(kind, workspace.memory_budget - plan.held, resident.capacity)
            if plan.chunk or not tiling.pair_capacity(workspace):
                return self.render_complete(resident, view)
            resident.cached_frames.pop(key, None)  # an interrupt leaves a part of a recording
            commands = CommandList(self.program) if recorded is None else recorded.commands
            frame = self._frame(resident, view, plan, commands, queue, pair_limit)
            frame.lease_images(self.features.images)
            render(frame)
            resident.cached_frames[key] = CachedFrame(plan, kind, None, RecordedFrame(frame))
            return frame

    def images_of(self, frame: DeviceFrame) -> OpenCLImages:
        """The output images of a frame."""
        return self._images(frame.batch, [Rendered.of(frame)], frame.resident)

    def render_again(self, resident: Resident, view: View) -> Rendered:
        """A frame whose replay exceeded its capacity, with the buffers that it requires."""
        with self.workspace.rendering():
            return Rendered.of(self._render_planned(resident, view, self._planner.frame(resident, view)))

    def profile(self, resident: Resident, view: View, recorded: RecordedFrame) -> dict[str, float]:
        """Milliseconds by stage, of a frame that is rendered once more on a queue with profiling."""
        workspace = self.workspace
        with workspace.rendering():
            queue = workspace.switch_to(workspace.queue)
            workspace.frames += 1
            if self._ready(recorded, resident, view, queue):
                leased, events = recorded.submit(queue)
                named = list(zip(recorded.commands.stages, events, strict=True))
                rendered = Rendered(queue, leased, dict, events[-1], named)
            else:
                rendered = self.render_again(resident, view)
            workspace.finish()
            workspace.pool.give_back(rendered.leased)
        return rendered.timings()

    def _replay(self, resident: Resident, views: ViewBatch, cached: CachedFrame) -> OpenCLImages | None:
        """The next frame of a kind; None if the buffers of the last were released."""
        workspace, view, recorded = self.workspace, views.view, cached.recorded
        workspace.pool.make_way(cached.kind, workspace.memory_budget - cached.plan.held, resident.capacity)
        if not tiling.pair_capacity(workspace):
            return None
        queue = workspace.switch_to(workspace.replay_queue)
        workspace.frames += 1
        if recorded is not None and self._ready(recorded, resident, view, queue):
            leased, events = recorded.submit(queue)
            stats = partial(
                read_stats, workspace.read_queue, dict(leased)["counts"], events[-1], resident.count
            )
            rendered = Rendered(queue, leased, stats, events[-1])
        else:
            commands = CommandList(self.program) if recorded is None else recorded.commands
            cached.recorded = None  # an interrupt leaves a part of a recording
            frame = self._frame(resident, view, cached.plan, commands, queue)
            frame.lease_images(self.features.images)
            render(frame)
            rendered = Rendered.of(frame, timed=False)
            cached.recorded = recorded = RecordedFrame(frame)
        images = self._images(views, [rendered], resident, replay=Replay(self, resident, view, recorded))
        if not resident.immutable:
            images.complete()
        return images

    def _ready(self, recorded: RecordedFrame, resident: Resident, view: View, queue: cl.CommandQueue) -> bool:
        """Bind a view to a recorded frame; whether it can be submitted."""
        if not recorded.valid:
            return False
        if not recorded.knows(view):
            plan = MemoryPlan(0, 0, 0)
            recorded.learn(self._frame(resident, view, plan, recorded.commands, queue))
        return recorded.set_view(view, queue)

    def _frame(
        self,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
        commands: CommandList,
        replay_queue: cl.CommandQueue | None = None,
        pair_limit: int = 0,
    ) -> DeviceFrame:
        return DeviceFrame(
            *(self.workspace, commands, self.shape, resident, ViewBatch.single(view), plan),
            **{"replay_queue": replay_queue, "pair_limit": pair_limit},
        )

    def _render_planned(
        self,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
    ) -> DeviceFrame:
        """A frame with the buffers that it requires."""
        # buffers of other kinds of frames are released; those of its own kind are part of the plan
        free = self.workspace.memory_budget - plan.held
        self.workspace.pool.make_way(self._buffer_kind(resident, view, plan), free, resident.capacity)
        frame = self._frame(resident, view, plan, self._commands)
        frame.lease_images(self.features.images)
        render(frame)
        return frame

    def _buffer_kind(self, resident: Resident, view: View, plan: MemoryPlan) -> tuple[Any, ...]:
        """Frames of one kind have buffers of the same sizes."""
        alike = resident.buffer_key if not plan.chunk else None
        return self, view.width, view.height, alike or (resident.capacity, plan)

    def _is_replayable(self, frame: DeviceFrame) -> bool:
        """Whether the next frame of its kind can be recorded."""
        resident, complete = frame.resident, not (frame.plan.chunk or frame.in_bands or frame.view.sub_frames)
        return complete and self.shape.lists != "ordered" and resident.count > 0 and not resident.streamed

    def _cache(self, resident: Resident, key: tuple[Any, ...], frame: DeviceFrame) -> None:
        """Replay the next frame of this kind."""
        cached, raster = resident.cached_frames, frame.view.raster
        rasters = {each.raster for each in cached.values()} - {None, raster}
        if len(cached) >= _KINDS or (raster is not None and len(rasters) >= _RASTERS):
            cached.clear()
        kind = self._buffer_kind(resident, frame.view, frame.plan)
        cached[key] = CachedFrame(frame.plan, kind, raster)

    def _key(self, view: View) -> tuple[Any, ...]:
        """What frames have in common that differ in numbers only."""
        labels = tuple(label for label, _ in view.groups)
        budgets = self.workspace.memory_budget, self.workspace.pair_budget
        return self, view.width, view.height, view.raster, labels, budgets

    def _images(
        self,
        views: ViewBatch,
        rendered: list[Rendered],
        resident: Resident,
        leased: list[tuple[str, cl.Buffer]] | None = None,
        replay: Replay | None = None,
    ) -> OpenCLImages:
        outputs = self.features.images
        return OpenCLImages(
            self.workspace, outputs, views, self.shape, rendered, resident.count, leased, replay
        )

    def _listing(self, lists: str) -> OpenCLPipeline:
        """The pipeline with another tile-binning strategy."""
        return self._other(self.features, replace(self.shape, lists=lists))

    def _for_part(self, resident: Resident, plan: MemoryPlan, views: ViewBatch) -> OpenCLPipeline:
        """The pipeline that bins a part of a batch in the shortest time."""
        if self.shape.lists != "tiled":
            return self
        if plan.chunk:
            return self._listing("ordered")  # as `render`
        few = len(views) > 1 and self._planner.tiles(views.view) <= tiling.LOCAL_TILES
        return self._listing("local") if few or resident.coherent else self

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Render one frame and return what the stages pass on.

        keys (n,) uint32; starts (tiles + 1,) uint32; lists (pairs,) uint32, of the last band; records (n,) of
        the record `Splat` (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the padded sample grid; and the output images by name.
        """
        with self.workspace.rendering():
            plan = MemoryPlan(0, resident.count, 0)
            frame = self._frame(resident, view, plan, self._commands)
            frame.lease_images(self.features.images)
            render(frame)
        images = self.images_of(frame)
        return {
            "keys": frame.read("keys", np.uint32, (resident.count,)),
            "starts": frame.read("starts", np.uint32, (frame.tiles + 1,)),
            "lists": frame.read("lists", np.uint32, (images.stats["pairs"],)),
            "records": frame.read("splats", self.source.records["Splat"], (resident.count,)),
            "raw": frame.read("raw", np.float32, (4, frame.rows, frame.stride)),
            **{output.name: images.read(output.name, 0) for output in self.features.images},
        }
