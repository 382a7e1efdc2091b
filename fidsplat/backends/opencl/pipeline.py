"""Runs the stages of one FeatureSet on one device: project, sort, bin, blend, resolve.

Nothing passes through the host between the stages but the number of (splat, tile) pairs, which sizes one
buffer. A picture with more pairs than the device's budget is listed and blended in bands of tiles, with the
same bits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.base import View
from fidsplat.backends.opencl.assemble import DeviceShape, Source
from fidsplat.backends.opencl.memory import Resident
from fidsplat.effects import FeatureSet
from fidsplat.effects.catalogue import Output
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.backend import OpenCLBackend

# words of the buffer `counts`: lists' lengths (64 bits each) that kernels read
_ALL, _VISIBLE, _PAIRS = 0, 2, 4


class OpenCLPlanes:
    """Finished planes on the device, with the events of the kernels that made them."""

    def __init__(
        self,
        queue: cl.CommandQueue,
        outputs: dict[str, tuple[Output, cl.Buffer]],
        size: tuple[int, int],
        events: list[tuple[str, cl.Event]],
        stats: dict[str, int],
    ) -> None:
        self._queue, self._outputs, self._size, self._events = queue, outputs, size, events
        self.stats: Mapping[str, int] = stats

    def read(self, name: str) -> np.ndarray:
        output, buffer = self._outputs[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        plane = np.empty(shape, output.dtype)
        cl.enqueue_copy(self._queue, plane, buffer)
        return plane

    @property
    def timings(self) -> dict[str, float]:
        self._queue.finish()
        timings: dict[str, float] = {}
        for stage, event in self._events:
            timings[stage] = timings.get(stage, 0.0) + (event.profile.end - event.profile.start) * 1e-6
        return timings


class OpenCLPipeline:
    """Compiled stages."""

    def __init__(
        self,
        backend: OpenCLBackend,
        source: Source,
        program: cl.Program,
        features: FeatureSet,
        shape: DeviceShape,
    ) -> None:
        self.source = source
        self.features = features
        self.shape = shape
        self.backend = backend
        self.kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        self._real = np.float64 if features.setup_precision == "float64" else np.float32

    def render(self, resident: Resident, view: View) -> OpenCLPlanes:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        try:
            return _Run(self, resident, view).planes()
        except cl.Error as error:
            raise DeviceError(f"{self.backend.info.title} failed while drawing: {error}") from error

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; order (visible,) uint32, splat indices by depth; starts (tiles + 1,) uint32;
        lists (pairs,) uint32, of the last band; records (n, words) float32 (undefined for culled splats);
        raw (4, rows, columns) float32: r, g, b, transmittance of the padded sample grid; and the finished
        outputs by name.
        """
        run = _Run(self, resident, view)
        planes = run.planes()
        stats = planes.stats
        words = self.source.record_bytes // 4
        return {
            "keys": run.read("keys", np.uint32, (resident.count,)),
            "order": run.read("order", np.uint32, (stats["visible"],)),
            "starts": run.read("starts", np.uint32, (run.tiles + 1,)),
            "lists": run.read("lists", np.uint32, (stats["pairs"],)),
            "records": run.read("splats", np.float32, (resident.count, words)),
            "raw": run.read("raw", np.float32, (4, run.rows, run.stride)),
            **{output.name: planes.read(output.name) for output in self.features.outputs},
        }


class _Run:
    """One picture: the stages in order, each a method."""

    def __init__(self, pipeline: OpenCLPipeline, resident: Resident, view: View) -> None:
        self.pipeline, self.resident, self.view = pipeline, resident, view
        self.backend, self.shape = pipeline.backend, pipeline.shape
        self.queue, self.pool = self.backend.queue, self.backend.pool
        self.tiles_x = -(-view.width // self.shape.tile_width)
        self.tiles_y = -(-view.height // self.shape.tile_height)
        self.tiles = self.tiles_x * self.tiles_y
        self.stride = self.tiles_x * self.shape.tile_width
        self.rows = self.tiles_y * self.shape.tile_height
        self.events: list[tuple[str, cl.Event]] = []
        self.held: dict[str, cl.Buffer] = {}

    def planes(self) -> OpenCLPlanes:
        self._project()
        self._sort()
        visible, pairs = self._count()
        raw_planes = self._sample_planes()
        for first, end, listed in self._bands(pairs):
            self._list(first, end, listed)
            self._blend(first, end, raw_planes)
        outputs = self._resolve(raw_planes)
        size = (self.view.height // self.view.samples, self.view.width // self.view.samples)
        stats = {"splats": self.resident.count, "visible": visible, "pairs": pairs}
        return OpenCLPlanes(self.queue, outputs, size, self.events, stats)

    def read(self, name: str, dtype, shape: tuple[int, ...]) -> np.ndarray:
        array = np.empty(shape, dtype)
        if array.size:
            cl.enqueue_copy(self.queue, array, self.held[name])
        return array

    # stages

    def _project(self) -> None:
        count, source = self.resident.count, self.pipeline.source
        view = self._put("view", self._uniforms())
        counts = np.zeros(6, np.uint32)
        counts[_ALL] = count
        self._put("counts", counts)
        splats = self._take("splats", count * source.record_bytes)
        bounds = self._take("bounds", count * source.bounds_bytes)
        keys = self._take("keys", count * 4)
        if count == 0:
            return
        cloud = self.resident.buffers
        inputs = [name for effect in self.pipeline.features.effects for name in effect.inputs]
        if self.resident.planes is not None and "plane_keys" in inputs:
            cloud = cloud | {"plane_keys": self._put("plane keys", self.resident.planes.keys(self.view))}
        extra = [cloud[name] for name in inputs]
        self._launch(
            "project",
            "project",
            count,
            64,
            np.uint32(count),
            view,
            *(cloud[name] for name in ("means", "quats", "scales", "opacities")),
            splats,
            bounds,
            keys,
            *extra,
        )

    def _sort(self) -> None:
        """Visible splats by depth, ties by index."""
        size, bins = self.resident.count * 4, 1 << self.shape.radix_bits
        table = self._take("sort table", 4 * bins * self.shape.chunks)
        keys, order = self.held["keys"], self._take("order 0", size)
        for number, shift in enumerate(range(0, 32, self.shape.radix_bits)):
            slot = np.uint32(_ALL if number == 0 else _VISIBLE)
            keys_out = self._take(f"sorted keys {number % 2}", size)
            order_out = self._take(f"order {(number + 1) % 2}", size)
            counts = self.held["counts"]
            self._launch(
                "sort", "sort_count", self.shape.chunks, 1, keys, counts, slot, np.uint32(shift), table
            )
            starts = self._starts("sort", table, bins, _VISIBLE)
            args = (keys, order, counts, slot, np.uint32(shift), np.uint32(number == 0), table, starts)
            self._launch("sort", "sort_scatter", self.shape.chunks, 1, *args, keys_out, order_out)
            keys, order = keys_out, order_out
        self.held["order"] = order

    def _count(self) -> tuple[int, int]:
        """Lengths of the tiles' lists; returns the numbers of visible splats and of pairs."""
        table = self._take("bin table", 4 * self.tiles * self.shape.chunks)
        size = (np.int32(self.view.width), np.int32(self.view.height))
        self.walk = (
            self.held["order"],
            self.held["counts"],
            np.uint32(_VISIBLE),
            self.held["bounds"],
            *size,
            table,
        )
        self._launch("bin", "bin_count", self.shape.chunks, 1, *self.walk)
        self.held["starts"] = self._starts("bin", table, self.tiles, _PAIRS)
        counts = np.empty(6, np.uint32)
        cl.enqueue_copy(self.queue, counts, self.held["counts"])
        visible, pairs = (int(counts[k]) | int(counts[k + 1]) << 32 for k in (_VISIBLE, _PAIRS))
        return visible, pairs

    def _bands(self, pairs: int) -> Iterator[tuple[int, int, int]]:
        """Ranges of tiles (first, end, pairs) whose lists fit the budget; one, unless the picture is crowded.

        A band holds at least one tile, whatever its list.
        """
        if pairs <= self.backend.pair_budget:
            yield 0, self.tiles, pairs
            return
        ends = np.cumsum(self.read("bin totals", np.uint32, (self.tiles,)), dtype=np.int64)
        first, done = 0, 0
        while first < self.tiles:
            end = int(np.searchsorted(ends, done + self.backend.pair_budget, side="right"))
            end = max(end, first + 1)
            yield first, end, int(ends[end - 1]) - done
            first, done = end, int(ends[end - 1])

    def _list(self, first: int, end: int, pairs: int) -> None:
        """The lists of the tiles of one band."""
        lists = self._take("lists", 4 * pairs)
        band = (self.held["starts"], np.int32(first), np.int32(end), np.uint32(pairs))
        self._launch("bin", "bin_emit", self.shape.chunks, 1, *self.walk, *band, lists)

    def _sample_planes(self) -> list[cl.Buffer]:
        """Planes that blending fills: raw, then those of the taps in order."""
        plane = 4 * self.rows * self.stride
        raw = self._take("raw", 4 * plane)
        extra = [
            self._take(f"raw {effect.name} {k}", planes * plane)
            for effect in self.pipeline.features.effects
            for k, planes in enumerate(effect.planes)
        ]
        return [raw, *extra]

    def _blend(self, first: int, end: int, sample_planes: list[cl.Buffer]) -> None:
        """Draws the tiles of one band."""
        group = 1 if self.shape.schedule == "lanes" else self.shape.tile_width * self.shape.tile_height
        view = self.view
        self._launch(
            "blend",
            "blend",
            (end - first) * group,
            group,
            *(self.held[name] for name in ("splats", "lists", "starts")),
            np.uint32(first),
            np.int32(view.width),
            np.int32(view.height),
            np.float32(view.log_cut),
            np.float32(view.ceiling),
            np.float32(view.stop),
            np.float32(1.0 / view.samples**2),
            *sample_planes,
        )

    def _resolve(self, raw_planes: list[cl.Buffer]) -> dict[str, tuple[Output, cl.Buffer]]:
        view, features = self.view, self.pipeline.features
        height, width = view.height // view.samples, view.width // view.samples
        outputs = {
            output.name: (output, self.pool.fresh(output.name, 4 * height * width * output.channels))
            for output in features.outputs
        }
        extra, rest = [], iter(raw_planes[1:])
        for effect in features.effects:
            extra += [next(rest) for _ in effect.planes]
            if effect.output:
                extra.append(outputs[effect.output.name][1])
        kernel = self.pipeline.kernels["resolve"]
        local = (16, 4)
        size = (-(-width // 16) * 16, -(-height // 4) * 4)
        background = (np.float32(channel) for channel in view.background)
        fixed = (np.int32(width), np.int32(height), np.int32(self.stride), np.uint32(self.rows * self.stride))
        event = kernel(self.queue, size, local, *fixed, *background, raw_planes[0], outputs["rgb"][1], *extra)
        self.events.append(("resolve", event))
        return outputs

    # helpers

    def _starts(self, stage: str, table: cl.Buffer, bins: int, slot: int) -> cl.Buffer:
        """Turns a table of counts into places: returns where each bin starts (bins + 1)."""
        totals = self._take(f"{stage} totals", 4 * bins)
        starts = self._take(f"{stage} starts", 4 * (bins + 1))
        items = self.shape.scan_items
        self._launch(stage, "scan_chunks", bins, 64, np.uint32(bins), table, totals)
        scan = (np.uint32(bins), totals, starts, self.held["counts"], np.uint32(slot))
        self._launch(stage, "scan_bins", items, items, *scan)
        return starts

    def _uniforms(self) -> np.ndarray:
        view = self.view
        tail = [view.fx, view.fy, view.cx, view.cy, view.near, view.far, view.log_cut]
        tail += [view.width, view.height, 1.0 / view.samples**2]
        parts = [view.rotation.ravel(), view.translation, view.eye, tail]
        return np.concatenate(parts).astype(self.pipeline._real)

    def _take(self, name: str, size: int) -> cl.Buffer:
        self.held[name] = buffer = self.pool.scratch(name, size)
        return buffer

    def _put(self, name: str, array: np.ndarray) -> cl.Buffer:
        buffer = self._take(name, array.nbytes)
        cl.enqueue_copy(self.queue, buffer, array)
        return buffer

    def _launch(self, stage: str, kernel: str, items: int, group: int, *args) -> None:
        """One-dimensional launch of at least `items` work-items; the kernels check their index."""
        size = -(-items // group) * group
        event = self.pipeline.kernels[kernel](self.queue, (size,), (group,), *args)
        self.events.append((stage, event))
