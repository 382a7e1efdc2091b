"""The stages compiled for one FeatureSet on one Warp device, and the replay of frames.

The second frame with the same cloud, image size and number of views does not wait for its number of pairs:
its lists have the largest capacity that earlier frames needed, plus an eighth. If its pairs exceed the
capacity, it is rendered again when it is read. From the third frame on, all stages except resolve are one
captured CUDA graph with constant arguments; values that differ between views are in input arrays.
"""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.view import View
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.command_list import LaunchCache, Launcher, capture
from fidsplat.backends.warp.frame import DeviceFrame, ImageArrays
from fidsplat.backends.warp.images import Rendered, WarpImages
from fidsplat.backends.warp.memory_plan import MemoryPlanner
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import ArrayPool, Workspace

_SPARE = 256
"""constant added to a capacity, in addition to an eighth"""
_MAX_KINDS = 8
"""maximum number of cached frames of a cloud"""


@dataclass(frozen=True)
class RecordedFrame:
    """A frame and the CUDA graph of its stages except resolve."""

    frame: DeviceFrame
    graph: Any

    def replay(self, batch: ViewBatch) -> None:
        if len(batch) > 1 or batch.view is not self.frame.view:
            self.frame.set_views(batch)
        load().capture_launch(self.graph)


@dataclass(eq=False)
class _CachedFrame:
    """Input arrays, list capacity and recorded launches of a cloud, for frames of one size and number
    of views."""

    inputs: ArrayPool
    """pool of the input arrays that the host fills for the views"""
    capacity: int
    """of the lists, in pairs"""
    token: tuple[Any, ...] = ()
    recorded: RecordedFrame | None = None

    def release_arrays(self) -> None:
        self.recorded = None


class WarpPipeline(Pipeline):
    """Compiled stages, with cached capacities and recorded frames of each cloud."""

    def __init__(self, program: Program, workspace: Workspace, launches: LaunchCache) -> None:
        self.program, self.workspace, self._launches = program, workspace, launches
        self.outputs = {output.name: output for output in program.images}
        self._planner = MemoryPlanner(program, workspace)
        workspace.pool.holders.add(launches)
        self._cached: WeakKeyDictionary[WarpCloud, dict[tuple[int, int, int], _CachedFrame]] = (
            WeakKeyDictionary()
        )

    def render_view(self, cloud: WarpCloud, view: View) -> WarpImages:
        return self.render(cloud, ViewBatch.single(view))

    def render(self, cloud: WarpCloud, batch: ViewBatch) -> WarpImages:
        wp, device = load(), self.workspace.device
        with self.workspace.working("while rendering"):
            images, into = self._new_images(cloud, batch)
            if batch.is_single:
                images.rendered.append(self._render(cloud, batch, into))
                return images
            if len(batch) < batch.total:
                images.blank()
            for first, end in self._planner.plan_batch(cloud, batch, images.nbytes):
                indices = batch.batch_indices[first:end].astype(np.int32)
                indices = wp.array(indices, dtype=wp.int32, device=device)
                sub_batch = batch.sub_batch(first, end)
                images.rendered.append(self._render(cloud, sub_batch, replace(into, indices=indices)))
            return images

    def render_counted(self, cloud: WarpCloud, view: View) -> tuple[DeviceFrame, WarpImages]:
        """Render one view and wait. Returns the images, and the frame, which is valid until the next
        frame."""
        with self.workspace.working("while rendering"):
            batch = ViewBatch.single(view)
            images, into = self._new_images(cloud, batch)
            frame, rendered = self._render_counted(cloud, batch, into)
            images.rendered.append(rendered)
            return frame, images

    def _new_images(self, cloud: WarpCloud, batch: ViewBatch) -> tuple[WarpImages, ImageArrays]:
        images = WarpImages(self.workspace, self.outputs, batch.size, batch.total, cloud.count)
        return images, ImageArrays(images.allocate, self.workspace.first_index, images.nbytes)

    def render_intermediates(self, cloud: WarpCloud, view: View) -> dict[str, np.ndarray]:
        """Render one view; returns the buffers between the stages: keys (n,) uint32; starts (tiles + 1,);
        lists (pairs,), of the last range of tiles; records (n, words) float32; raw (4, rows, columns)
        float32: r, g, b, transmittance; output images by name."""
        frame, images = self.render_counted(cloud, view)
        named, stats, n = frame.named, images.stats, cloud.count
        rows, stride = frame.grid
        raw = named["raw color"].numpy()[: rows * stride]
        records = named["records"].numpy()[: n * self.program.layout.vec4s]
        return {
            "keys": named["keys"].numpy()[:n].copy(),
            "starts": named["starts"].numpy()[: frame.tiles + 1].astype(np.uint32),
            "lists": named["lists"].numpy()[: stats["pairs"]].astype(np.uint32),
            "records": records.reshape(n, -1).copy(),
            "raw": raw.reshape(rows, stride, 4).transpose(2, 0, 1).copy(),
            **{output.name: images.read(output.name, 0) for output in self.program.images},
        }

    def _render_counted(
        self, cloud: WarpCloud, batch: ViewBatch, into: ImageArrays
    ) -> tuple[DeviceFrame, Rendered]:
        launcher = Launcher(self._launches)
        frame = DeviceFrame(self.program, self._planner, cloud, batch, launcher, into.reserved)
        self.workspace.frames += 1
        frame.render()
        if not batch.view.sub_frames:
            self._update_capacity(cloud, batch, frame.stats["pairs"])
        frame.resolve(into, launcher)
        return frame, Rendered(launcher, frame.stats)

    def _render(self, cloud: WarpCloud, batch: ViewBatch, into: ImageArrays) -> Rendered:
        """Render views, without waiting if a frame with the same key is cached."""
        workspace, view = self.workspace, batch.view
        # frames of the user's own arrays (`wrap_arrays`) must wait for their counts: a frame that overflows
        # its buffers is rendered again, and by then the user may have changed the arrays
        if not workspace.asynchronous or view.sub_frames or cloud.wraps_arrays or not cloud.count:
            return self._render_counted(cloud, batch, into)[1]
        cached = self._cached.get(cloud, {}).get((view.width, view.height, len(batch)))
        if cached is None:
            return self._render_counted(cloud, batch, into)[1]
        # after a failure or another frame the inputs are undefined
        capacity, recorded, cached.recorded = cached.capacity, cached.recorded, None
        if recorded is not None and cached.token == self._token(cached, view, into.reserved):
            recorded.replay(batch)
            cached.recorded = recorded
            workspace.frames += 1
            launcher = Launcher(self._launches, timed=False)
            return self._pending(cloud, batch, capacity, recorded.frame, launcher, into)
        launcher = Launcher(self._launches)
        given = into.reserved, capacity, cached.inputs
        frame = DeviceFrame(self.program, self._planner, cloud, batch, launcher, *given)
        if not frame.fits(capacity):
            return self._render_counted(cloud, batch, into)[1]
        workspace.frames += 1
        frame.render()
        rendered = self._pending(cloud, batch, capacity, frame, launcher, into)
        self._record(cached, frame, into.reserved)
        return rendered

    def _pending(
        self,
        cloud: WarpCloud,
        batch: ViewBatch,
        capacity: int,
        frame: DeviceFrame,
        launcher: Launcher,
        into: ImageArrays,
    ) -> Rendered:
        """A submitted frame whose number of pairs is compared with the capacity later."""
        workspace, pool = self.workspace, frame.pool
        acquired = pool.acquire("totals", 2, load().int64)
        load().copy(acquired[0], frame.named["totals"])
        frame.resolve(into, launcher)
        rendered = Rendered(launcher, {"splats": cloud.count, "visible": 0, "pairs": 0})
        # return the array to the pool for later frames
        weakref.finalize(rendered, pool.release, "totals", acquired)
        stats = rendered.counts  # the closure references only the counts, so that the object can be released

        def complete() -> Rendered | None:
            with workspace.device_errors("while rendering"):
                launcher.finish()
            visible, pairs = acquired[1].tolist()
            stats.update(visible=visible, pairs=pairs)
            if pairs <= capacity:
                return None
            with workspace.working("while rendering"):
                return self._render_counted(cloud, batch, into)[1]

        def profile() -> Mapping[str, float]:
            """Measure the stages by rendering again: one view into new arrays, a batch into its own."""
            with workspace.working("while rendering"):
                own = into
                if len(batch) == 1:
                    arrays = {name: load().empty_like(array) for name, array in into.allocate().items()}
                    own = replace(into, allocate=lambda: arrays)
                return self._render_counted(cloud, batch, own)[1].timings()

        rendered.complete = complete
        if not launcher.timed:
            rendered.profile = profile
        return rendered

    def _record(self, cached: _CachedFrame, frame: DeviceFrame, reserved: int) -> None:
        """Record a frame if its launches equal the launches of the previous frame."""
        token, before = self._token(cached, frame.view, reserved), frame.launcher
        if self.workspace.replays and token == cached.token:
            frame.launcher = Launcher(self._launches, timed=False, divided=False)
            graph = capture(self.workspace, frame.render)
            frame.launcher = before
            # recorded frames must not reference the cloud, which caches them
            frame.cloud = weakref.proxy(frame.cloud)
            cached.recorded = None if graph is None else RecordedFrame(frame, graph)
            self.workspace.pool.holders.add(cached)
        cached.token = token

    def _token(self, cached: _CachedFrame, view: View, reserved: int) -> tuple[Any, ...]:
        """Key of the launches of a frame: all their arguments except the numeric uniforms."""
        workspace, labels = self.workspace, tuple(label for label, _ in view.groups)
        budgets = workspace.memory_budget, workspace.pair_budget, reserved
        states = workspace.pool.generation, cached.inputs.generation
        external = view.external_depth and view.external_depth.depth.shape
        return cached.capacity, budgets, states, view.raster, view.environment_map, labels, external

    def _update_capacity(self, cloud: WarpCloud, batch: ViewBatch, pairs: int) -> None:
        kinds, kind = self._cached.setdefault(cloud, {}), (batch.view.width, batch.view.height, len(batch))
        cached = kinds.get(kind)
        if cached is None:
            if len(kinds) >= _MAX_KINDS:
                kinds.clear()
            cached = kinds[kind] = _CachedFrame(ArrayPool(self.workspace.device), -1)
        if pairs > cached.capacity:
            cached.capacity = pairs + pairs // 8 + _SPARE
