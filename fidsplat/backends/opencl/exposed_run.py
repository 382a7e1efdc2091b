"""A picture of several poses: its shots are blended one after another, then resolved as one picture."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.memory import Resident
from fidsplat.backends.opencl.plan import Plan
from fidsplat.backends.opencl.run import Run
from fidsplat.backends.view import Shot, View
from fidsplat.effects.catalogue import Output

if TYPE_CHECKING:
    from fidsplat.backends.opencl.pipeline import OpenCLPipeline


class ExposedRun(Run):
    """A run whose samples come from the shots of its view, in their order."""

    def __init__(self, pipeline: OpenCLPipeline, resident: Resident, view: View, plan: Plan) -> None:
        super().__init__(pipeline, resident, view, plan)
        self._counts = {"splats": resident.count, "visible": 0, "pairs": 0}
        self.stats = lambda: self._counts

    def draw(self) -> dict[str, tuple[Output, cl.Buffer]]:
        """All stages of all shots; returns the outputs by name."""
        plane = self.rows * self.stride
        effects = self.pipeline.features.effects
        kinds = [(4, True), *((planes, effect.averaged) for effect in effects for planes in effect.planes)]
        # names that no shot's own planes have
        whole = [self.take(f"exposed {k}", 4 * plane * count) for k, (count, _) in enumerate(kinds)]
        # what is around is the same for all shots
        around = {
            name: self.put(name, self.view.array(name))
            for effect in effects
            for name in effect.backdrop_arrays
        }
        for shot in self.view.shots:
            run = Run(self.pipeline, self.resident, shot.view, self.plan)
            run.held |= around
            *_, planes = run.filled()
            self.events += run.events
            self._gather(run, shot, planes, whole, kinds)
            for name, value in run.stats().items():
                self._counts[name] = max(self._counts[name], value)
            self.uploads += run.uploads
            self.pool.give_back(run.leased)
        if self.view.raster is not None and any(effect.resolve_inputs for effect in effects):
            self.held |= self.backend.ray_buffers.of(self.view.raster, self.rows, self.stride)
        outputs = self.outputs()
        self.resolve(whole, outputs)
        return outputs

    def _gather(
        self,
        run: Run,
        shot: Shot,
        planes: list[cl.Buffer],
        whole: list[cl.Buffer],
        kinds: list[tuple[int, bool]],
    ) -> None:
        """Adds a shot's samples to the picture's. kinds: of each buffer its planes, and whether they are
        averaged."""
        size = (np.int32(shot.view.width), np.int32(shot.view.height))
        strides = (np.int32(run.stride), np.uint32(run.rows * run.stride))
        strides += (np.int32(self.stride), np.uint32(self.rows * self.stride), np.int32(shot.top))
        items = (-(-shot.view.width // 16) * 16, -(-shot.view.height // 4) * 4)
        mean = (np.float32(shot.weight), np.int32(shot.first))
        for (count, averaged), mine, every in zip(kinds, planes, whole, strict=True):
            if averaged or shot.middle:
                kernel, how = ("expose", mean) if averaged else ("expose_planes", ())
                args = (*size, *strides, np.int32(count), *how, mine, every)
                event = self.pipeline.launch(self.queue, kernel, items, (16, 4), args)
                self.events.append(("expose", event))
