"""Runs the stages of one FeatureSet on one Warp device: project, sort, bin, blend, resolve.

The host reads two numbers between the stages, how many splats are drawn and how many pairs of splats and
tiles there are: they
size arrays and launches. A picture with more pairs than the device's budget is drawn in bands of tiles, with
the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.around import Surroundings
from fidsplat.backends.warp.finished import WarpPlanes
from fidsplat.backends.warp.launch import BLOCK, Launcher
from fidsplat.backends.warp.memory import Resident
from fidsplat.effects import FeatureSet
from fidsplat.effects.catalogue import Output
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.warp.backend import WarpBackend, WarpShape

KNOWN = frozenset(
    {"camera_pinhole", "color_rgb", "color_sh", "lowpass_none", "lowpass_screen", "lowpass_pixel"}
    | {"stop_inclusive", "stop_exclusive", "compose_ordered", "compose_planes", "ray_depth"}
    | {"sh_terms", "arithmetic_precise", "keys_short"}
    | {"perspective", "footprint_gaussian", "footprint_box", "footprint_mixed", "box_edges"}
    | {"background_constant", "background_gradient", "background_panorama", "fog"}
    | {"ray", "ray_length", "sample_length", "turn", "world_ray"}
    | {"alpha", "depth", "depth_median", "depth_first", "distance", "distance_median", "distance_first"}
    | {"normal", "normal_world", "label", "splat_id", "blended"}
)
"""effects that kernels/warp has"""
# of these depend on an effect: a stage is compiled once for all feature sets that mean the same to it
_RECORD = ("lowpass_screen", "ray_depth", "normal", "compose_planes", "footprint_box", "footprint_mixed")
_PROJECT = (*_RECORD, "lowpass_pixel")
_SAMPLE = (*_RECORD, "stop_exclusive", "depth", "depth_median", "depth_first", "heaviest", "blended", "fog")


# of a View, by the names that the kernels have for them too
_UNIFORMS = (
    *("fx", "fy", "cx", "cy", "near", "far", "width", "height", "samples"),
    *("log_cut", "ceiling", "stop", "first_light", "fog_density"),
)
# bytes: of one splat's bounds; of its window, keys, counts, drawn, places, sums; of one that is drawn, in
# sort and lists; of a pair with the scratch of its sort
_BOUNDS, _PROJECTED, _VISIBLE, _PAIR = 44, 36, 40, 24


class WarpPipeline:
    """Compiled stages."""

    def __init__(self, backend: WarpBackend, features: FeatureSet, shape: WarpShape) -> None:
        names = {effect.name for effect in features.effects}
        lacking = sorted(names - KNOWN)
        if lacking:
            raise DeviceError(
                f"{backend.info.name} ({backend.info.platform}) has no {', '.join(lacking)}; "
                "use an OpenCL device for it"
            )
        self.backend, self.features, self.shape = backend, features, shape
        if names & {"label", "splat_id"}:
            names |= {"heaviest"}  # both are the same splat's
        record = tuple(name for name in _RECORD if name in names)
        sample = tuple(name for name in _SAMPLE if name in names)
        terms = (features.sh_degree + 1) ** 2 if "color_sh" in names else 0
        screen = "lowpass_screen" in names
        with runtime.quiet():
            self.layout = runtime.kernels("records").Layout(record)
            self.project = runtime.kernels("project").make_project(
                tuple(name for name in _PROJECT if name in names),
                terms,
                features.setup_precision,
                shape.schedule == "tiles",
            )
            self.project_block = runtime.kernels("project").BLOCK
            self.lists = runtime.kernels("lists").make_lists(screen)
            self.sort = runtime.kernels("lists")
            self.block_dim = shape.tile_width * shape.tile_height
            """threads that draw a tile on a GPU"""
            self.blend, self.state = runtime.kernels("blend").make_blend(
                sample, shape.schedule == "group", self.block_dim
            )
            planes = runtime.kernels("planes")
            self.sample_planes = planes.of_samples(sample)
            """type of an element of each"""
            finished = tuple(output.name for output in features.outputs)
            integers = tuple(output.name for output in features.outputs if output.dtype == "int32")
            self.samples_type = planes.make_samples(tuple(self.sample_planes.items()))
            self.outputs_type = planes.make_outputs(finished, integers)
            kinds = runtime.kernels("surroundings").KINDS
            behind = next((kind for kind in kinds if f"background_{kind}" in names), "constant")
            self.surroundings = Surroundings(backend, behind)
            self.resolve = runtime.kernels("resolve").make_resolve(
                finished, integers, tuple(self.sample_planes.items()), behind, features.samples
            )
            common = [self.sort.compact, self.sort.gather, self.sort.find_starts, self.sort.sum_up]
            for kernel in (self.project, self.lists.emit, self.blend, self.resolve, *common):
                self._compile(kernel)

    def _compile(self, kernel: Any) -> None:
        # here rather than at the first launch: several threads launch it
        block = {self.blend: self.block_dim, self.project: self.project_block}.get(kernel, BLOCK)
        if not self.backend.device.is_cuda:
            block = 1
        try:
            loaded = kernel.module.load(self.backend.device, block)
        except Exception as error:
            raise DeviceError(f"{self.backend.info.name} cannot compile {kernel.key}: {error}") from error
        if loaded is None:
            raise DeviceError(
                f"{self.backend.info.name} cannot compile {kernel.key}; Warp says more on stderr"
            )

    def load_banding(self) -> None:
        """Compile what only a picture with more pairs than the budget needs."""
        with runtime.quiet():
            self._compile(self.lists.histogram)
            self._compile(self.lists.count)

    def render(self, resident: Resident, view: View) -> WarpPlanes:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        return self._drawn(resident, view).planes

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; order (visible,), splat indices by depth; starts (tiles + 1,); lists (pairs,), of
        the last band;
        records (n, words) float32 (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the
        padded sample grid; and the finished outputs by name.
        """
        run = self._drawn(resident, view)
        stats = run.planes.stats
        rows, stride = run.grid
        raw = run.held["raw color"].numpy()[: rows * stride]
        return {
            "keys": run.held["keys"].numpy()[: resident.count].copy(),
            "order": run.held["order"].numpy()[: stats["visible"]].astype(np.uint32),
            "starts": run.held["starts"].numpy()[: run.tiles + 1].astype(np.uint32),
            "lists": run.held["lists"].numpy()[: stats["pairs"]].astype(np.uint32),
            "records": run.held["lines"]
            .numpy()[: resident.count * self.layout.lines]
            .reshape(resident.count, -1)
            .copy(),
            "raw": raw.reshape(rows, stride, 4).transpose(2, 0, 1).copy(),
            **{output.name: run.planes.read(output.name) for output in self.features.outputs},
        }

    def _drawn(self, resident: Resident, view: View) -> _Run:
        wp = runtime.load()
        try:
            with wp.ScopedDevice(self.backend.device):
                return _Run(self, resident, view)
        except RuntimeError as error:
            if isinstance(error, DeviceError):
                raise
            raise DeviceError(f"{self.backend.info.name} failed while drawing: {error}") from error


class _Run:
    """One picture: the stages in order, each a method."""

    def __init__(self, pipeline: WarpPipeline, resident: Resident, view: View) -> None:
        self.pipeline, self.resident, self.view = pipeline, resident, view
        self.backend, self.pool, shape = pipeline.backend, pipeline.backend.pool, pipeline.shape
        self.wp = runtime.load()
        self.launcher = Launcher(self.backend)
        self.launch = self.launcher.launch
        tiles_x, tiles_y = -(-view.width // shape.tile_width), -(-view.height // shape.tile_height)
        self.tiles = tiles_x * tiles_y
        self.grid = tiles_y * shape.tile_height, tiles_x * shape.tile_width
        self.held: dict[str, Any] = {}
        self.u = self._uniforms(tiles_x, tiles_y)
        self._take("starts", self.tiles + 1, self.wp.int32)
        self._take("lists", 1, self.wp.int32)
        self._take("order", 1, self.wp.int32)
        self._take("bounds", resident.count, runtime.kernels("bounds").Bounds)
        self._take("lines", resident.count * pipeline.layout.lines, self.wp.vec4)

        self.launcher.stage("project")
        visible, pairs = self._project() if resident.count else (0, 0)
        self.launcher.stage("sort")
        if pairs:
            self._sort(visible)
        samples = self._samples()
        for first, end, listed in self._bands(visible, pairs):
            self.launcher.stage("bin")
            self._list(visible, first, end, listed, whole=listed == pairs)
            self.launcher.stage("blend")
            self._blend(first, end, samples)
        self.launcher.stage("resolve")
        outputs, size = self._resolve(samples)
        self.launcher.stage(None)
        stats = {"splats": resident.count, "visible": visible, "pairs": pairs}
        self.planes = WarpPlanes(outputs, size, self.launcher, stats)

    # stages

    def _project(self) -> tuple[int, int]:
        wp, n = self.wp, self.resident.count
        keys, counts = self._take("keys", n, wp.uint32), self._exact("counts", n, wp.int64)
        drawn, places = self._exact("drawn", n, wp.int32), self._exact("places", n, wp.int32)
        ends = self._exact("ends by index", n, wp.int64)
        cloud = [self.resident.arrays[name] for name in ("means", "quats", "scales", "opacities", "colors")]
        cloud += self._planes()
        cloud.append(self.resident.arrays.get("boxes", drawn))  # not read where all are of one kind
        records = [self.held["lines"], self.held["bounds"], self._take("windows", n, wp.uint64)]
        self.launcher.launch(
            self.pipeline.project,
            n,
            self.u,
            *cloud,
            *records,
            keys,
            counts,
            drawn,
            block=self.pipeline.project_block,
        )
        wp.utils.array_scan(drawn, places, inclusive=True)
        wp.utils.array_scan(counts, ends, inclusive=True)
        totals = self._take("totals", 2, wp.int64)
        self.launcher.once(self.pipeline.sort.sum_up, 1, n, places, ends, totals)
        visible, pairs = self.launcher.read_back(totals, self.pool.host("totals", 2, wp.int64))
        return visible, pairs

    def _planes(self) -> list[Any]:
        """Each splat's plane, and the planes' sort keys in this view."""
        planes = self.resident.planes
        if planes is None or "compose_planes" not in self.pipeline.features.slots:
            return [self._take("no planes", 1, self.wp.int32), self._take("plane keys", 1, self.wp.float32)]
        keys = planes.keys(self.view)
        array = self._take("plane keys", len(keys), self.wp.float32)
        self.wp.copy(array, self.wp.array(keys, dtype=self.wp.float32, device="cpu"), count=len(keys))
        return [self.resident.arrays["planes"], array]

    def _sort(self, visible: int) -> None:
        """Splats that are drawn by depth, ties by index."""
        wp = self.wp
        # the sort takes the second half as its scratch
        keys = self._take("sorted keys", 2 * visible, wp.uint32)
        order = self._take("order", 2 * visible, wp.int32)
        given = (self.held[name] for name in ("keys", "drawn", "places"))
        leading = wp.uint32(-1 << (32 - self.pipeline.features.depth_key_bits) & 0xFFFFFFFF)
        self.launch(self.pipeline.sort.compact, self.resident.count, *given, leading, keys, order)
        wp.utils.radix_sort_pairs(keys, order, visible)

    def _bands(self, visible: int, pairs: int) -> Iterator[tuple[int, int, int]]:
        """Ranges of tiles (first, end, pairs) whose lists fit the budget; one, unless the picture is crowded.

        A band holds at least one tile, whatever its list.
        """
        budget = min(self.backend.pair_budget, self._room(visible))
        if pairs <= budget:
            yield 0, self.tiles, pairs
            return
        totals = self._take("tile totals", self.tiles, self.wp.int32)
        totals.zero_()
        self.pipeline.load_banding()
        # in one piece: on the CPU its sums are plain additions
        args = (0, self.u, self.held["order"], self.held["windows"], self.held["bounds"], totals)
        self.launcher.once(self.pipeline.lists.histogram, visible, *args)
        ends = np.cumsum(totals.numpy()[: self.tiles], dtype=np.int64)
        first, done = 0, 0
        while first < self.tiles:
            end = max(int(np.searchsorted(ends, done + budget, side="right")), first + 1)
            yield first, end, int(ends[end - 1]) - done
            first, done = end, int(ends[end - 1])

    def _room(self, visible: int) -> int:
        """How many pairs may be listed at once within the memory budget.

        Raises:
            DeviceError: what else the picture needs is more than that.
        """
        budget, resident = self.backend.memory_budget, self.resident
        # as `_project`, `_sort`, `_list`, `_samples` and `_resolve` take them; the sorts have as much again
        each = 16 * self.pipeline.layout.lines + _BOUNDS + _PROJECTED
        fixed = resident.nbytes + each * resident.count + _VISIBLE * visible
        sample = sum(map(self.wp.types.type_size_in_bytes, self.pipeline.sample_planes.values()))
        fixed += self.grid[0] * self.grid[1] * sample
        pixel = sum(4 * output.channels for output in self.pipeline.features.outputs)
        fixed += self.view.width * self.view.height // self.view.samples**2 * pixel
        fixed += self.pipeline.surroundings.nbytes(self.view)
        room = (budget - fixed) // _PAIR
        if room < 1:
            raise DeviceError(
                f"a memory budget of {budget / 2**20:.0f} MiB is too small for {resident.count} splats in "
                f"this picture, which take {fixed / 2**20:.0f} MiB before their lists; raise memory_budget, "
                "or use an OpenCL device, which draws a cloud in chunks"
            )
        return room

    def _list(self, visible: int, first: int, end: int, pairs: int, whole: bool) -> None:
        """The lists of the tiles of one band, each in depth order."""
        wp, held = self.wp, self.held
        tiles = self._take("tiles", 2 * pairs, wp.int32)
        lists = self._take("lists", 2 * pairs, wp.int32)
        if pairs:
            lengths, ends = (self._exact(name, visible, wp.int64) for name in ("lengths", "ends"))
            if whole:
                self.launch(self.pipeline.sort.gather, visible, held["order"], held["counts"], lengths)
            else:
                band = (first, end, held["order"], held["windows"], held["bounds"], lengths)
                self.launch(self.pipeline.lists.count, visible, self.u, *band)
            wp.utils.array_scan(lengths, ends, inclusive=True)
            band = (first, end, held["order"], held["windows"], held["bounds"], ends, lengths, tiles, lists)
            self.launch(self.pipeline.lists.emit, visible, self.u, *band)
            wp.utils.radix_sort_pairs(tiles, lists, pairs, 0, max(self.tiles - 1, 1).bit_length())
        self.launch(self.pipeline.sort.find_starts, end - first + 1, pairs, first, tiles, held["starts"])

    def _samples(self) -> Any:
        """Planes that blending fills, as one struct."""
        samples = self.pipeline.samples_type()
        size = self.grid[0] * self.grid[1]
        for name, dtype in self.pipeline.sample_planes.items():
            setattr(samples, name, self._take(f"raw {name}", size, dtype))
        return samples

    def _blend(self, first: int, end: int, samples: Any) -> None:
        """Draws the tiles of one band."""
        pipeline, held = self.pipeline, self.held
        lists = held["starts"], held["lists"]
        planes = self.resident.arrays.get("planes", held["lists"])  # not read where there are none
        args = (self.u, held["lines"], planes, *lists, samples)
        area = pipeline.shape.tile_width * pipeline.shape.tile_height
        if pipeline.shape.schedule == "group":
            count = (end - first) * pipeline.block_dim
            self.launcher.blocks(pipeline.blend, count, pipeline.block_dim, first, *args)
            return
        state = self._take("state", self.launcher.pieces * area, pipeline.state)
        self.launcher.tiles(pipeline.blend, first, end, area, *args, held["bounds"], state)

    def _resolve(self, samples: Any) -> tuple[dict[str, tuple[Output, Any]], tuple[int, int]]:
        view, wp = self.view, self.wp
        height, width = view.height // view.samples, view.width // view.samples
        outputs, finished = {}, self.pipeline.outputs_type()
        for output in self.pipeline.features.outputs:
            dtype = wp.int32 if output.dtype == "int32" else wp.float32
            # asked for anew: the caller keeps them
            array = self.pool.fresh(output.name, height * width * output.channels, dtype)
            outputs[output.name] = output, array
            setattr(finished, output.name, array)
        around = self.pipeline.surroundings.of(view)
        if "label" in outputs:
            finished.labels = self.resident.arrays["labels"]
        self.launch(self.pipeline.resolve, height * width, self.u, width, around, samples, finished)
        return outputs, (height, width)

    # helpers

    def _take(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.scratch(name, size, dtype)
        return array

    def _exact(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.exact(name, size, dtype)
        return array

    def _uniforms(self, tiles_x: int, tiles_y: int) -> Any:
        view, shape, wp = self.view, self.pipeline.shape, self.wp
        u = runtime.kernels("common").View()
        u.per_fx, u.per_fy, u.per_near = 1.0 / view.fx, 1.0 / view.fy, 1.0 / view.near
        u.rotation = wp.mat33d(*view.rotation.ravel().tolist())
        u.translation, u.eye = wp.vec3d(*view.translation.tolist()), wp.vec3d(*view.eye.tolist())
        for name in _UNIFORMS:
            setattr(u, name, getattr(view, name))
        u.tile_w, u.tile_h, u.tiles_x, u.tiles_y = shape.tile_width, shape.tile_height, tiles_x, tiles_y
        u.per_pixel = 1.0 / view.samples**2
        fx, fy, cx, cy = view.uniform("ray")
        u.ray = wp.vec4(1 / fx, 1 / fy, cx, cy)
        return u
