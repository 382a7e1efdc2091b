"""The stages compiled for one FeatureSet on one Warp device."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.view import View
from fidsplat.backends.warp.command_list import LaunchCache
from fidsplat.backends.warp.frame import DeviceFrame, ImageArrays
from fidsplat.backends.warp.images import WarpImages
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.recorded_frame import FrameRenderer
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import Workspace


class WarpPipeline(Pipeline):
    """Compiled stages."""

    def __init__(self, program: Program, workspace: Workspace, launches: LaunchCache) -> None:
        self.program, self.workspace = program, workspace
        self.outputs = {output.name: output for output in program.images}
        self._renderer = FrameRenderer(program, workspace, launches)

    def render_view(self, resident: Resident, view: View) -> WarpImages:
        with self.workspace.working("while rendering"):
            images, into = self._new_images(resident, view)
            views = ViewBatch.single(view)
            images.rendered.append(self._renderer.render(resident, views, into, images.nbytes))
            return images

    def render(self, resident: Resident, views: ViewBatch) -> WarpImages:
        wp, device = load(), self.workspace.device
        with self.workspace.working("while rendering"):
            images = WarpImages(self.workspace, self.outputs, views.size, views.total, resident.count)
            if len(views) < views.total:
                images.blank()
            for first, end in self._renderer.planner.parts(resident, views, images.nbytes):
                indices = views.batch_indices[first:end].astype(np.int32)
                into = ImageArrays(images.arrays, wp.array(indices, dtype=wp.int32, device=device))
                part = views.part(first, end)
                images.rendered.append(self._renderer.render(resident, part, into, images.nbytes))
            return images

    def render_counted(self, resident: Resident, view: View) -> tuple[DeviceFrame, WarpImages]:
        """Render one view and wait for its counts. Returns the frame, whose arrays are valid until the next
        frame, and the images.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.working("while rendering"):
            images, into = self._new_images(resident, view)
            views = ViewBatch.single(view)
            frame, rendered = self._renderer.render_counted(resident, views, into, images.nbytes)
            images.rendered.append(rendered)
            return frame, images

    def _new_images(self, resident: Resident, view: View) -> tuple[WarpImages, ImageArrays]:
        size = view.height // view.samples, view.width // view.samples
        images = WarpImages(self.workspace, self.outputs, size, splats=resident.count)
        return images, ImageArrays(images.arrays, self.workspace.first_index)

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
