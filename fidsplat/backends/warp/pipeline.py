"""The stages compiled for one FeatureSet on one Warp device."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fidsplat.backends.batched_views import ViewBatch, ViewStack
from fidsplat.backends.interface import Pipeline
from fidsplat.backends.view import View
from fidsplat.backends.warp.ahead import Drawing
from fidsplat.backends.warp.batch import WarpBatch, parts
from fidsplat.backends.warp.images import WarpImages
from fidsplat.backends.warp.launch import Commands
from fidsplat.backends.warp.picture import Picture, view_bytes
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.workspace import Workspace


class WarpPipeline(Pipeline):
    """Draws pictures that call for these features."""

    def __init__(self, program: Program, workspace: Workspace, commands: Commands) -> None:
        self.program, self.workspace = program, workspace
        self._drawing = Drawing(program, workspace, commands)

    def render(self, resident: Resident, view: View) -> WarpImages:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.working("while drawing"):
            return self._drawing.images(resident, ViewStack.alone(view))

    def drawn(self, resident: Resident, view: View) -> tuple[Picture, WarpImages]:
        """One picture with all that its stages have left on the device, until another is drawn; its images.

        Raises:
            DeviceError: as `render`.
        """
        with self.workspace.working("while drawing"):
            return self._drawing.picture(resident, ViewStack.alone(view))

    def render_batch(self, resident: Resident, batch: ViewBatch) -> WarpBatch:
        """Draw many views, as many at once as memory holds.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.working("while drawing"):
            images = WarpBatch(self.workspace, self.program.images, batch, resident.count)
            for first, end in self._parts(resident, batch, images.nbytes):
                stack = batch.part(first, end)
                into = images.into(batch.slots[first:end])
                images.add(self._drawing.images(resident, stack, into, images.nbytes))
            return images

    def _parts(self, resident: Resident, batch: ViewBatch, beside: int) -> Iterator[tuple[int, int]]:
        """Ranges of views (first, end) that are drawn at once. beside: bytes of all their images."""
        count, views, workspace = len(batch.slots), batch.views, self.workspace
        if not (count and isinstance(views, ViewStack) and self._goes_together(views)):
            return iter([(k, k + 1) for k in range(count)])
        each, samples = view_bytes(self.program, resident, views.view)
        free = workspace.memory_budget - resident.memory_bytes - beside
        return parts(count, each, samples, resident.count * self.program.layout.lines, self.workspace, free)

    def _goes_together(self, stack: ViewStack) -> bool:
        """Whether all that differs from view to view stands in the struct `View`."""
        return not (self.program.sensor and stack.numbers)

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; order (visible,), splat indices by depth; starts (tiles + 1,); lists (pairs,), of
        the last band; records (n, words) float32 (undefined for culled splats); raw (4, rows, columns)
        float32: r, g, b, transmittance of the padded sample grid; and the finished outputs by name.
        """
        picture, images = self.drawn(resident, view)
        held, stats, n = picture.held, images.stats, resident.count
        rows, stride = picture.grid
        raw = held["raw color"].numpy()[: rows * stride]
        lines = held["lines"].numpy()[: n * self.program.layout.lines]
        return {
            "keys": held["keys"].numpy()[:n].copy(),
            "order": held["order"].numpy()[: stats["visible"]].astype(np.uint32),
            "starts": held["starts"].numpy()[: picture.tiles + 1].astype(np.uint32),
            "lists": held["lists"].numpy()[: stats["pairs"]].astype(np.uint32),
            "records": lines.reshape(n, -1).copy(),
            "raw": raw.reshape(rows, stride, 4).transpose(2, 0, 1).copy(),
            **{output.name: images.read(output.name) for output in self.program.images},
        }
