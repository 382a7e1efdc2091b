"""The stages compiled for one FeatureSet on one Warp device."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.view import View
from fidsplat.backends.warp.command_list import LaunchCache
from fidsplat.backends.warp.frame import DeviceFrame
from fidsplat.backends.warp.images import WarpBatch, WarpImages
from fidsplat.backends.warp.memory_plan import MemoryPlanner
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.recorded_frame import FrameRenderer
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.workspace import Workspace


class WarpPipeline(Pipeline):
    """Compiled stages."""

    def __init__(self, program: Program, workspace: Workspace, launches: LaunchCache) -> None:
        self.program, self.workspace = program, workspace
        self._renderer = FrameRenderer(program, workspace, launches)
        self._planner = MemoryPlanner(program, workspace)

    def render_view(self, resident: Resident, view: View) -> WarpImages:
        """Render one view.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.working("while rendering"):
            return self._renderer.render(resident, ViewBatch.single(view))

    def render(self, resident: Resident, views: ViewBatch) -> WarpImages | WarpBatch:
        """Render views, as many at once as memory holds. Raises DeviceError as `render_view`."""
        if views.is_single:
            return self.render_view(resident, views.one(0))
        with self.workspace.working("while rendering"):
            images = WarpBatch(self.workspace, self.program.images, views, resident.count)
            for first, end in self._planner.parts(resident, views, images.nbytes):
                into = images.arrays_of(views.batch_indices[first:end])
                images.add(self._renderer.render(resident, views.part(first, end), into, images.nbytes))
            return images

    def render_counted(self, resident: Resident, view: View) -> tuple[DeviceFrame, WarpImages]:
        """Render one view; its frame, whose arrays are valid until another is rendered, and its images.

        Raises:
            DeviceError: as `render`.
        """
        with self.workspace.working("while rendering"):
            return self._renderer.render_counted(resident, ViewBatch.single(view))

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Render one view and return the data between the stages.

        keys (n,) uint32; order (visible,), splat indices by depth; starts (tiles + 1,); lists (pairs,), of
        the last band; records (n, words) float32 (undefined for culled splats); raw (4, rows, columns)
        float32: r, g, b, transmittance of the padded sample grid; and the finished outputs by name.
        """
        frame, images = self.render_counted(resident, view)
        named, stats, n = frame.named, images.stats, resident.count
        rows, stride = frame.grid
        raw = named["raw color"].numpy()[: rows * stride]
        lines = named["lines"].numpy()[: n * self.program.layout.lines]
        return {
            "keys": named["keys"].numpy()[:n].copy(),
            "order": named["order"].numpy()[: stats["visible"]].astype(np.uint32),
            "starts": named["starts"].numpy()[: frame.tiles + 1].astype(np.uint32),
            "lists": named["lists"].numpy()[: stats["pairs"]].astype(np.uint32),
            "records": lines.reshape(n, -1).copy(),
            "raw": raw.reshape(rows, stride, 4).transpose(2, 0, 1).copy(),
            **{output.name: images.read(output.name, 0) for output in self.program.images},
        }
