"""One picture: the stages project, lists, blend, resolve on an in-order queue.

Nothing passes through the host between the stages but the number of (splat, tile) pairs, which sizes one
buffer. A picture with more pairs than the device's budget is listed and blended in bands of tiles, with the
same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.lists import LISTS
from fidsplat.backends.opencl.memory import Resident
from fidsplat.backends.opencl.plan import Plan
from fidsplat.backends.view import View
from fidsplat.effects.catalogue import Output

if TYPE_CHECKING:
    from fidsplat.backends.opencl.pipeline import OpenCLPipeline


class Run:
    """The buffers and launches of one picture."""

    def __init__(self, pipeline: OpenCLPipeline, resident: Resident, view: View, plan: Plan) -> None:
        self.pipeline, self.resident, self.view, self.plan = pipeline, resident, view, plan
        self.backend, self.shape = pipeline.backend, pipeline.shape
        self.queue, self.pool = self.backend.queue, self.backend.pool
        self.tiles_x = -(-view.width // self.shape.tile_width)
        self.tiles_y = -(-view.height // self.shape.tile_height)
        self.tiles = self.tiles_x * self.tiles_y
        self.stride = self.tiles_x * self.shape.tile_width
        self.rows = self.tiles_y * self.shape.tile_height
        self.events: list[tuple[str, cl.Event]] = []
        self.uploads: list[cl.Event] = []
        self.held: dict[str, cl.Buffer] = {}
        self.leased: list[tuple[str, cl.Buffer]] = []
        self.stats: Callable[[], dict[str, int]] = dict

    def draw(self) -> dict[str, tuple[Output, cl.Buffer]]:
        """All stages; returns the outputs by name."""
        outputs = self.outputs()
        for planes in self.filled():
            self.resolve(planes, outputs)
        return outputs

    def filled(self) -> Iterator[list[cl.Buffer]]:
        """All stages but the last: yields the sample planes, raw first, when all tiles are blended.

        Where lists were made before the host knew their length it may do so twice: what is launched then is
        under way while the host waits, and what comes last counts.
        """
        planes = self._sample_planes()
        # not an attribute: in a cycle, all that this picture holds would wait for the garbage collector
        lists = LISTS["chunked" if self.plan.chunk else self.shape.lists](self)
        for first, end in lists.bands():
            self._blend(first, end, planes)
            if end == self.tiles:
                if "world_ray" in self.pipeline.features.names:
                    self._backdrop(planes[0])
                yield planes
        self.stats = lists.stats()

    # stages

    def _sample_planes(self) -> list[cl.Buffer]:
        """Planes that blending fills: raw, then those of the taps in order."""
        plane = 4 * self.rows * self.stride
        raw = self.take("raw", 4 * plane)
        extra = [
            self.take(f"raw {effect.name} {k}", planes * plane)
            for effect in self.pipeline.features.effects
            for k, planes in enumerate(effect.planes)
        ]
        return [raw, *extra]

    def _blend(self, first: int, end: int, sample_planes: list[cl.Buffer]) -> None:
        """Draws the tiles of one band."""
        group = self.shape.blend_items
        view = self.view
        self.launch(
            "blend",
            "blend",
            (end - first) * group,
            group,
            *(self.held[name] for name in ("splats", "lists", "starts")),
            np.uint32(first),
            np.int32(view.width),
            np.int32(view.height),
            *map(self.pipeline.wide, (view.log_cut, view.ceiling, view.stop, 1.0 / view.samples**2)),
            *self._blend_args(sample_planes),
        )

    def _blend_args(self, sample_planes: list[cl.Buffer]) -> list:
        """raw, then each effect's uniforms, arrays of the view and planes."""
        planes = iter(sample_planes)
        args: list = [next(planes)]
        for effect in self.pipeline.features.effects:
            args += self._uniforms(effect.blend_uniforms)
            args += [self.held[name] for name in effect.blend_inputs]
            args += [next(planes) for _ in effect.planes]
        return args

    def _backdrop(self, raw: cl.Buffer) -> None:
        """Adds what the samples see behind everything."""
        view = self.view
        size = (np.int32(view.width), np.int32(view.height))
        strides = (np.int32(self.stride), np.uint32(self.rows * self.stride))
        args = [*size, *strides, *self._uniforms(("ray", "rotation")), raw]
        for effect in self.pipeline.features.effects:
            args += self._uniforms(effect.backdrop_uniforms)
            for name in effect.backdrop_arrays:
                args.append(self.held[name] if name in self.held else self.put(name, view.array(name)))
            args += [self.held[name] for name in effect.backdrop_inputs]
        items = (-(-view.width // 16) * 16, -(-view.height // 4) * 4)
        self.events.append(
            ("resolve", self.pipeline.launch(self.queue, "backdrop", items, (16, 4), tuple(args)))
        )

    def _uniforms(self, names: tuple[str, ...]) -> list[np.generic]:
        if not names:  # of nearly all effects, several times a picture
            return []
        numbers = [number for name in names for number in self.view.uniform(name)]
        return [number if isinstance(number, np.generic) else np.float32(number) for number in numbers]

    def outputs(self) -> dict[str, tuple[Output, cl.Buffer]]:
        """Room for the finished planes, by name."""
        pixels = (self.view.height // self.view.samples) * (self.view.width // self.view.samples)
        return {
            output.name: (output, self.lease(output.name, 4 * pixels * output.channels))
            for output in self.pipeline.features.outputs
        }

    def resolve(self, raw_planes: list[cl.Buffer], outputs: dict[str, tuple[Output, cl.Buffer]]) -> None:
        """The last stage: pixels from samples."""
        view, features = self.view, self.pipeline.features
        height, width = view.height // view.samples, view.width // view.samples
        extra, rest = [], iter(raw_planes[1:])
        for effect in features.effects:
            extra += self._uniforms(effect.resolve_uniforms)
            extra += [self.put(name, self.view.array(name)) for name in effect.resolve_arrays]
            extra += [self.held[name] for name in effect.resolve_inputs]
            extra += [next(rest) for _ in effect.planes]
            if effect.output:
                extra.append(outputs[effect.output.name][1])
        background = (np.float32(channel) for channel in view.background)
        fixed = (np.int32(width), np.int32(height), np.int32(self.stride), np.uint32(self.rows * self.stride))
        args = (*fixed, *background, raw_planes[0], outputs["rgb"][1], *extra)
        size = (-(-width // 16) * 16, -(-height // 4) * 4)
        self.events.append(("resolve", self.pipeline.launch(self.queue, "resolve", size, (16, 4), args)))

    # what the stages and the lists share

    def read(self, name: str, dtype, shape: tuple[int, ...]) -> np.ndarray:
        """The contents of a buffer; waits for the device."""
        array = np.empty(shape, dtype)
        if array.size:
            cl.enqueue_copy(self.queue, array, self.held[name])
        return array

    def take(self, name: str, size: int) -> cl.Buffer:
        """A scratch buffer that this picture calls `name`."""
        self.held[name] = buffer = self.pool.scratch(name, size)
        return buffer

    def lease(self, name: str, size: int) -> cl.Buffer:
        """A buffer that is this picture's own until its planes are not needed any more."""
        self.held[name] = buffer = self.pool.lease(name, size)
        self.leased.append((name, buffer))
        return buffer

    def put(self, name: str, array: np.ndarray) -> cl.Buffer:
        """A scratch buffer with these contents; does not wait. What the last picture put there and nobody can
        change (a panorama) is not copied again."""
        if (held := self.pool.holding(name, array)) is not None:
            self.held[name] = held
            return held
        buffer = self.take(name, array.nbytes)
        self.uploads.append(cl.enqueue_copy(self.queue, buffer, array, is_blocking=False))
        self.pool.now_holds(name, array)
        return buffer

    def launch(self, stage: str, kernel: str, items: int, group: int, *args) -> cl.Event:
        """One-dimensional launch of at least `items` work-items; the kernels check their index."""
        size = -(-items // group) * group
        event = self.pipeline.launch(self.queue, kernel, (size,), (group,), args)
        self.events.append((stage, event))
        return event

    def bands_of(self, totals: np.ndarray, start: int = 0) -> list[tuple[int, int, int]]:
        """Ranges of tiles (first, end, pairs) whose lists fit the budget.

        totals (k,): lengths of the lists of the tiles from `start` on. A band holds at least one tile.
        """
        ends = np.cumsum(totals, dtype=np.int64)
        bands, first, done = [], 0, 0
        while first < len(totals):
            end = int(np.searchsorted(ends, done + self.backend.pair_budget, side="right"))
            end = max(end, first + 1)
            bands.append((start + first, start + end, int(ends[end - 1]) - done))
            first, done = end, int(ends[end - 1])
        return bands

    def put_view(self, row: int, end: int) -> None:
        """The uniforms of the projection, for rows of samples [row, end)."""
        view = self.view
        if view.raster is not None:
            slopes = "rays_box" in self.pipeline.features.names
            self.held |= self.backend.ray_buffers.of(view.raster, self.rows, self.stride, slopes)
        views = np.array([_uniforms(each, row, end) for each in (view, *(of for _, of in view.groups))])
        self.put("view", views.astype(self.pipeline.real))
        if view.groups:
            head = [len(view.groups), views.shape[1]]
            self.put("moving", np.array([*head, *(label for label, _ in view.groups)], np.int32))
        if self.resident.planes is not None:
            self.put("plane_keys", self.resident.planes.keys(view))


def _uniforms(view: View, row: int, end: int) -> np.ndarray:
    """The buffer `view` (prelude.cl) for rows of samples [row, end)."""
    tail = [view.fx, view.fy, view.cx, view.cy, view.near, view.far, view.log_cut]
    tail += [view.width, view.height, 1.0 / view.samples**2, row, end]
    if view.raster is not None:
        tail += view.raster.uniforms
    return np.concatenate([view.rotation.ravel(), view.translation, view.eye, tail])
