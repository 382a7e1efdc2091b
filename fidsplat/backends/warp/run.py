"""One picture on a Warp device: the stages project, sort, bin, blend, resolve.

The host reads two numbers between the stages, how many splats are drawn and how many pairs of splats and
tiles there are: they size arrays and launches. A picture with more pairs than the device's budget is drawn in
bands of tiles, with the same bits.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.warp import exposure, motion, runtime
from fidsplat.backends.warp.finished import WarpPlanes
from fidsplat.backends.warp.launch import Launcher
from fidsplat.backends.warp.memory import Resident
from fidsplat.effects.catalogue import Output
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.warp.pipeline import WarpPipeline

# of a View, by the names that the kernels have for them too
_UNIFORMS = (
    *("fx", "fy", "cx", "cy", "near", "far", "width", "height", "samples"),
    *("log_cut", "ceiling", "stop", "first_light", "fog_density"),
)
# bytes: of one splat's bounds; of its window, keys, counts, drawn, places, sums; of one that is drawn, in
# sort and lists; of a pair with the scratch of its sort
_BOUNDS, _PROJECTED, _VISIBLE, _PAIR = 44, 36, 40, 24


class Run:
    """One picture: the stages in order, each a method."""

    def __init__(
        self, pipeline: WarpPipeline, resident: Resident, view: View, launcher: Launcher, beside: int = 0
    ) -> None:
        """beside: bytes on the device that belong to the picture of which this one is a part."""
        self.pipeline, self.resident, self.view = pipeline, resident, view
        self.backend, self.pool, shape = pipeline.backend, pipeline.backend.pool, pipeline.shape
        self.wp = runtime.load()
        self.launcher, self.launch, self.beside = launcher, launcher.launch, beside
        tiles_x, tiles_y = -(-view.width // shape.tile_width), -(-view.height // shape.tile_height)
        self.tiles = tiles_x * tiles_y
        self.grid = tiles_y * shape.tile_height, tiles_x * shape.tile_width
        self.held: dict[str, Any] = {}
        self.u = self._uniforms(tiles_x, tiles_y)
        self.stats: dict[str, int] = {"splats": resident.count, "visible": 0, "pairs": 0}

    def draw(self) -> None:
        """All stages; `planes` are the finished ones."""
        samples = self._exposed() if self.view.shots else self._drawn()
        self.launcher.stage("resolve")
        outputs, size = self._resolve(samples)
        self.launcher.stage(None)
        self.planes = WarpPlanes(outputs, size, self.launcher, self.stats)

    def _exposed(self) -> Any:
        """All stages but the last of each shot, and what their samples are together."""
        whole = self._samples("exposed")
        for shot in self.view.shots:
            run = Run(self.pipeline, self.resident, shot.view, self.launcher, self._planes_bytes())
            samples = run._drawn()
            self.launcher.stage("expose")
            exposure.gather(self.pipeline, self.launcher, shot, samples, whole, self.grid[1])
            self.stats = {name: max(value, run.stats[name]) for name, value in self.stats.items()}
        return whole

    def _drawn(self) -> Any:
        """All stages but the last; planes of samples."""
        self._take("starts", self.tiles + 1, self.wp.int32)
        self._take("lists", 1, self.wp.int32)
        self._take("order", 1, self.wp.int32)
        self._take("bounds", self.resident.count, runtime.kernels("bounds").Bounds)
        self._take("lines", self.resident.count * self.pipeline.layout.lines, self.wp.vec4)
        self.launcher.stage("project")
        self.lens = self.backend.lens_arrays.lens(self.view, self.pool)
        self.rays = self.backend.lens_arrays.rays(self.view, self.pool, sloped=self.pipeline.sloped)
        visible, pairs = self._project() if self.resident.count else (0, 0)
        self.launcher.stage("sort")
        if pairs:
            self._sort(visible)
        samples = self._samples()
        for first, end, listed in self._bands(visible, pairs):
            self.launcher.stage("bin")
            self._list(visible, first, end, listed, whole=listed == pairs)
            self.launcher.stage("blend")
            self._blend(first, end, samples)
        if self.pipeline.surroundings:
            # here, as shots may look in different directions
            self.launcher.stage("resolve")
            count, around = self.view.width * self.view.height, self.pipeline.surroundings
            # without the derivatives that blending may have: a struct of another type
            rays = self.backend.lens_arrays.rays(self.view, self.pool)
            self.launch(around.kernel, count, self.u, around.of(self.view), rays, samples.color)
        self.stats |= {"visible": visible, "pairs": pairs}
        return samples

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
            motion.moving(self.resident, self.view, self.pool),
            self.lens,
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
        self.launch(self.pipeline.sort.compact, self.resident.count, *given, keys, order)
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
        fixed += self._planes_bytes() + self.beside
        fixed += self.backend.lens_arrays.nbytes(self.view)
        if self.pipeline.surroundings:
            fixed += self.pipeline.surroundings.nbytes(self.view)
        room = (budget - fixed) // _PAIR
        if room < 1:
            raise DeviceError(
                f"a memory budget of {budget / 2**20:.0f} MiB is too small for {resident.count} splats in "
                f"this picture, which take {fixed / 2**20:.0f} MiB before their lists; raise memory_budget, "
                "or use an OpenCL device, which draws a cloud in chunks"
            )
        return room

    def _planes_bytes(self) -> int:
        """What planes of samples and of pixels take."""
        sample = sum(map(self.wp.types.type_size_in_bytes, self.pipeline.sample_planes.values()))
        pixel = sum(4 * output.channels for output in self.pipeline.features.outputs)
        pixels = self.view.width * self.view.height // self.view.samples**2
        return self.grid[0] * self.grid[1] * sample + pixels * pixel

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

    def _samples(self, kind: str = "raw") -> Any:
        """Planes that blending fills, as one struct; those of another kind are others."""
        samples = self.pipeline.samples_type()
        size = self.grid[0] * self.grid[1]
        for name, dtype in self.pipeline.sample_planes.items():
            setattr(samples, name, self._take(f"{kind} {name}", size, dtype))
        return samples

    def _blend(self, first: int, end: int, samples: Any) -> None:
        """Draws the tiles of one band."""
        pipeline, held = self.pipeline, self.held
        lists = held["starts"], held["lists"]
        planes = self.resident.arrays.get("planes", held["lists"])  # not read where there are none
        args = (self.u, self.rays, held["lines"], planes, *lists, samples)
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
        rays = self.backend.lens_arrays.rays(view, self.pool, given=self.pipeline.stretched)
        background = wp.vec3(*view.background)
        if "normal_world" in outputs:
            finished.turns = self._exact("turns", height, wp.mat33)
            wp.copy(finished.turns, wp.array(view.array("turns"), dtype=wp.mat33, device="cpu"))
        if "label" in outputs:
            finished.labels = self.resident.arrays["labels"]
        self.launch(self.pipeline.resolve, height * width, self.u, width, background, rays, samples, finished)
        if self.pipeline.sensor:
            args = self.pipeline.sensor.arguments(view, self.pool)
            self.launch(self.pipeline.sensor.kernel, height * width, *args, width, outputs["rgb"][1])
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
        u.ray_step = view.raster.step if view.raster and self.pipeline.sloped else 0.0
        fx, fy, cx, cy = view.uniform("ray")
        u.ray = wp.vec4(1 / fx, 1 / fy, cx, cy)
        return u
