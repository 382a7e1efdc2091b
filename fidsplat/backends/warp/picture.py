"""One picture on a Warp device: the stages project, sort, bin, blend, resolve.

The host reads two numbers between the stages, how many splats are drawn and how many pairs of splats and
tiles there are: they size arrays and launches. A picture with more pairs than the device's budget is drawn in
bands of tiles, with the same bits.

A picture of a kind that was drawn before does not wait for them: it is given `Room`, and says itself in
`counts` what it would have taken. Where that is more its lists are empty (ahead.py draws it again).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.backends.bands import cut
from fidsplat.backends.view import Shot, View
from fidsplat.backends.warp.launch import BLOCK, Launcher
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.backends.warp.structs import (
    lens_of,
    memory_bytes,
    moving_of,
    rays_of,
    surroundings_of,
    uniforms,
)
from fidsplat.backends.warp.workspace import Workspace
from fidsplat.effects import Output
from fidsplat.errors import DeviceError

_CONVERTING = threading.Lock()
# bytes: of one splat's bounds; of its window, keys, counts, drawn, places, sums; of one that is drawn, in
# sort and lists; of a pair with the scratch of its sort
_BOUNDS, _PROJECTED, _VISIBLE, _PAIR = 44, 36, 40, 24


class WarpImages:
    """The output images of one picture, on the device until asked for."""

    def __init__(
        self,
        images: dict[str, tuple[Output, Any]],
        size: tuple[int, int],
        launcher: Launcher,
        stats: dict[str, int],
    ) -> None:
        self._images, self._size, self._launcher, self._stats = images, size, launcher, stats
        self.settle: Callable[[], WarpImages | None] | None = None
        """of a picture that was drawn ahead: waits for it; what it is drawn again as, in the same arrays"""

    def _settled(self) -> None:
        if self.settle:
            again = self.settle()
            self.settle = None
            if again:
                self._launcher, self._stats = again._launcher, again._stats

    @property
    def stats(self) -> Mapping[str, int]:
        """How many splats there were, were drawn, and pairs of splats and tiles."""
        self._settled()
        return self._stats

    @property
    def arrays(self) -> dict[str, Any]:
        """What holds the images, drawn or not."""
        return {name: array for name, (_, array) in self._images.items()}

    def device_array(self, name: str) -> Any:
        """The image as a wp.array (h, w) or (h, w, 3) on the device; no copy."""
        self._settled()
        output, array = self._images[name]
        return array.reshape(self._size if output.channels == 1 else (*self._size, output.channels))

    def read(self, name: str) -> np.ndarray:
        """The image as a NumPy array of its own."""
        # a CPU array's numpy() is its own memory, which device_array gives away
        return np.array(self.device_array(name).numpy())

    def read_uint8(self, name: str) -> np.ndarray:
        """As `GivesUint8`."""
        drawn = self.device_array(name)
        made = load().empty(drawn.size, dtype=load().uint8, device=drawn.device)
        given = [drawn.flatten(), made]
        with _CONVERTING, quiet():  # pictures are read in any thread, and the first read compiles
            # not by `Launcher`, whose commands would keep the image
            load().launch(
                kernels("uint8").to_uint8, drawn.size, given, device=drawn.device, record_tape=False
            )
        return made.numpy().reshape(drawn.shape)

    def wait(self) -> None:
        """Until the device has drawn it."""
        self._settled()
        self._launcher.finish()

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds on the device by stage, in the order in which they ran."""
        self._settled()
        return self._launcher.timings()


@dataclass(frozen=True)
class Room:
    """For the lists of a picture."""

    visible: int
    """splats that are drawn"""
    pairs: int
    """of splats and tiles"""


class Picture:
    """One picture: the stages in order, each a method."""

    def __init__(
        self,
        program: Program,
        workspace: Workspace,
        resident: Resident,
        view: View,
        launcher: Launcher,
        beside: int = 0,
        into: Mapping[str, Any] | None = None,
        room: Room | None = None,
    ) -> None:
        """
        Args:
            beside: bytes on the device that belong to the picture or batch of which this one is a part.
            into: arrays for the output images, by name, instead of fresh ones.
            room: of its lists, instead of waiting for what they take.
        """
        self.program, self.workspace, self.pool = program, workspace, workspace.pool
        self.resident, self.view, self.launcher, self.beside = resident, view, launcher, beside
        self.into, self.room = into or {}, room
        self.counts: Any = None
        """of a picture with `room`: an array of the host, in which it says what its lists would take"""
        self.wp = load()
        u = uniforms(view, program.shape, program.sloped)
        self.tiles = u.tiles_x * u.tiles_y
        self.grid = u.tiles_y * u.tile_h, u.tiles_x * u.tile_w
        self.held: dict[str, Any] = {"view": u}
        """arrays and structs by the names that kernels' signatures have for them"""
        self.bands = 0
        """of tiles, in which it was drawn"""
        self.stats: dict[str, int] = {"splats": resident.count, "visible": 0, "pairs": 0}

    def draw(self) -> WarpImages:
        """All stages; the finished images."""
        self.workspace.pictures += 1
        self.samples = self._exposed() if self.view.shots else self._drawn()
        self.launcher.stage("resolve")
        images = self._resolve(self.samples)
        self.launcher.stage(None)
        return images

    def _exposed(self) -> Any:
        """All stages but the last of each shot, and what their samples are together."""
        whole = self._samples("exposed")
        beside = self.beside + self._image_bytes()
        for shot in self.view.shots:
            part = Picture(self.program, self.workspace, self.resident, shot.view, self.launcher, beside)
            samples = part._drawn()
            self.launcher.stage("expose")
            self._gather(shot, samples, whole)
            self.stats = {name: max(value, part.stats[name]) for name, value in self.stats.items()}
        return whole

    def _gather(self, shot: Shot, samples: Any, whole: Any) -> None:
        """Adds a shot's samples to the picture's: light is averaged, other buffers are those of one pose."""
        start, count = shot.top * self.grid[1], shot.view.height * self.grid[1]
        for name in self.program.sample_fields:
            mine, every = getattr(samples, name), getattr(whole, name)
            if name in self.program.expose:
                given = {"weight": shot.weight, "fresh": int(shot.first), "start": start}
                self.launcher.launch(
                    self.program.expose[name], count, {**given, "raw": mine, "exposed": every}
                )
            elif shot.middle:
                self.wp.copy(every, mine, dest_offset=start, count=count)

    def _drawn(self) -> Any:
        """All stages but the last; sample buffers."""
        wp, n, program = self.wp, self.resident.count, self.program
        self._take("starts", self.tiles + 1, wp.int32)
        self._take("lists", 1, wp.int32)
        self._take("order", 1, wp.int32)
        self._take("bounds", n, kernels("bounds").Bounds)
        self._take("lines", n * program.layout.lines, wp.vec4)
        self.launcher.stage("project")
        self.held["lens"] = lens_of(self.view, self.workspace)
        rays = rays_of(self.view, self.workspace, sloped=program.sloped, opaque=program.opaque)
        visible, pairs = self._project() if n else (0, 0)
        self.launcher.stage("sort")
        if pairs:
            self._sort(visible)
        samples = self._samples("raw")
        for first, end, listed in self._bands(visible, pairs):
            self.bands += 1
            self.launcher.stage("bin")
            self._list(visible, first, end, listed, whole=listed == pairs)
            self.launcher.stage("blend")
            self._blend(first, end, rays, samples)
        if program.backdrop:
            # here, as shots may look in different directions
            self.launcher.stage("resolve")
            given = {"surroundings": surroundings_of(self.view, self.workspace), "color": samples.color}
            # without the derivatives that blending may have: a struct of another type
            given["rays"] = rays_of(self.view, self.workspace)
            self._launch(program.backdrop, self.view.width * self.view.height, **given)
        self.stats |= {"visible": visible, "pairs": pairs}
        return samples

    # stages

    def _project(self) -> tuple[int, int]:
        wp, n, sort = self.wp, self.resident.count, self.program.sort
        self._take("windows", n, wp.uint64)
        self._take("keys", n, wp.uint32)
        counts, ends = self._exact("counts", n, wp.int64), self._exact("ends_by_index", n, wp.int64)
        drawn, places = self._exact("drawn", n, wp.int32), self._exact("places", n, wp.int32)
        # not read where all are of one kind
        cloud = {"boxes": drawn, "thickness": self.resident.arrays["opacities"]} | self.resident.arrays
        cloud |= {"moving": moving_of(self.resident, self.view, self.workspace)} | self._planes()
        self._launch(self.program.project, n, block=self.program.project_block, **cloud)
        wp.utils.array_scan(drawn, places, inclusive=True)
        wp.utils.array_scan(counts, ends, inclusive=True)
        totals = self._take("totals", 2, wp.int64)
        self.launcher.once(sort.sum_up, 1, {**self.held, "splats": n})
        if self.room:
            self.counts = self.pool.lend("totals", 2, wp.int64)
            wp.copy(self.counts, totals)
            return self.room.visible, self.room.pairs
        visible, pairs = self.launcher.read_back(totals, self.pool.host("totals", 2, wp.int64))
        return visible, pairs

    def _planes(self) -> dict[str, Any]:
        """Each splat's plane, and the planes' sort keys in this view."""
        wp, table = self.wp, self.resident.planes
        if table is None or not self.program.layered:
            none = self._take("no planes", 1, wp.int32), self._take("no plane keys", 1, wp.float32)
            return dict(zip(("planes", "plane_keys"), none, strict=True))
        keys = self.pool.filled("plane keys", table.keys(self.view), wp.float32)
        return {"planes": self.resident.arrays["planes"], "plane_keys": keys}

    def _sort(self, visible: int) -> None:
        """Splats that are drawn by depth, ties by index."""
        # the sort takes the second half as its scratch
        keys = self._take("sorted_keys", 2 * visible, self.wp.uint32)
        order = self._take("order", 2 * visible, self.wp.int32)
        if self.room:
            keys.fill_(0xFFFFFFFF)  # behind all that are drawn
        self._launch(self.program.sort.compact, self.resident.count, room=visible)
        self.wp.utils.radix_sort_pairs(keys, order, visible)

    def _bands(self, visible: int, pairs: int) -> Iterator[tuple[int, int, int]]:
        """Ranges of tiles (first, end, pairs) whose lists fit the budgets; one, unless they are long."""
        most = self._most_pairs(visible)
        if pairs <= most:
            return iter([(0, self.tiles, pairs)])
        totals = self._take("tile_totals", self.tiles, self.wp.int32)
        totals.zero_()
        self.program.load_banding()
        # in one piece: on the CPU its sums are plain additions
        self.launcher.once(self.program.lists.histogram, visible, {**self.held, "first": 0})
        return cut(totals.numpy()[: self.tiles], most)

    def _image_bytes(self) -> int:
        """What sample buffers, of the padded grid, and output images take."""
        sizes = map(self.wp.types.type_size_in_bytes, self.program.sample_fields.values())
        pixels = self.view.width * self.view.height // self.view.samples**2
        channels = sum(output.channels for output in self.program.images)
        return self.grid[0] * self.grid[1] * sum(sizes) + 4 * pixels * channels

    def fits(self, room: Room) -> bool:
        """Whether a picture with this room keeps to the budgets."""
        try:
            return room.pairs <= self._most_pairs(room.visible)
        except DeviceError:
            return False

    def settle(self) -> dict[str, int]:
        """What the lists of a picture with `room` would take, once it is done."""
        if self.counts is not None:
            self.launcher.finish()
            visible, pairs = self.counts.numpy().tolist()
            self.stats |= {"visible": visible, "pairs": pairs}
            self.pool.give_back("totals", self.counts)
            self.counts = None
        return self.stats

    def _most_pairs(self, visible: int) -> int:
        """How many pairs may be listed at once within the budgets.

        Raises:
            DeviceError: what else the picture needs is more than the memory budget.
        """
        workspace, resident = self.workspace, self.resident
        # as the stages take them; the sorts have as much again
        each = 16 * self.program.layout.lines + _BOUNDS + _PROJECTED
        fixed = resident.memory_bytes + each * resident.count + _VISIBLE * visible
        fixed += self._image_bytes() + self.beside + memory_bytes(self.view, workspace)
        pairs = (workspace.memory_budget - fixed) // _PAIR
        if pairs < 1:
            raise DeviceError(
                f"a memory budget of {workspace.memory_budget / 2**20:.0f} MiB is too small for "
                f"{resident.count} splats in this picture, which take {fixed / 2**20:.0f} MiB before their "
                "lists; raise memory_budget, or use an OpenCL device, which draws a cloud in chunks"
            )
        return min(workspace.pair_budget, pairs)

    def _list(self, visible: int, first: int, end: int, pairs: int, whole: bool) -> None:
        """The lists of the tiles of one band, each in depth order."""
        wp, lists, sort = self.wp, self.program.lists, self.program.sort
        tiles = self._take("tiles", 2 * pairs, wp.int32)
        listed = self._take("lists", 2 * pairs, wp.int32)
        band = {"band_first": first, "band_end": end}
        if pairs:
            lengths, ends = (self._exact(name, visible, wp.int64) for name in ("lengths", "ends"))
            self._launch(sort.gather if whole else lists.count, visible, **band, room=visible, pairs=pairs)
            wp.utils.array_scan(lengths, ends, inclusive=True)
            if self.room:
                tiles.fill_(self.tiles)  # behind the last
            self._launch(lists.emit, visible, **band)
            wp.utils.radix_sort_pairs(tiles, listed, pairs, 0, self.tiles.bit_length())
        self._launch(sort.find_starts, end - first + 1, **band, pairs=pairs)

    def _samples(self, kind: str) -> Any:
        """Sample buffers that blending fills, as one struct; those of another kind are others."""
        samples = self.program.samples_type()
        for name, dtype in self.program.sample_fields.items():
            setattr(samples, name, self._take(f"{kind} {name}", self.grid[0] * self.grid[1], dtype))
        return samples

    def _blend(self, first: int, end: int, rays: Any, samples: Any) -> None:
        """Draws the tiles of one band."""
        program, shape = self.program, self.program.shape
        planes = self.resident.arrays.get("planes", self.held["lists"])  # not read where there are none
        given = {**self.held, "rays": rays, "samples": samples, "planes": planes}
        area = shape.tile_width * shape.tile_height
        if shape.schedule == "group":
            count = (end - first) * program.block_dim
            self.launcher.once(program.blend, count, given | {"band_first": first}, program.block_dim)
            return
        given["state"] = self._take("state", self.launcher.pieces * area, program.state)
        self.launcher.tiles(program.blend, first, end, area, given)

    def _resolve(self, samples: Any) -> WarpImages:
        view, wp, program = self.view, self.wp, self.program
        height, width = view.height // view.samples, view.width // view.samples
        images, out = {}, program.images_type()
        for output in program.images:
            array = self.into.get(output.name)
            if array is None:  # a fresh one: the caller keeps it
                size, dtype = height * width * output.channels, getattr(wp, output.dtype)
                array = self.pool.fresh(output.name, size, dtype)
            images[output.name] = output, array
            setattr(out, output.name, array)
        for name in program.cloud_arrays:
            setattr(out, name, self.resident.arrays[name])
        for name, dtype in program.view_arrays.items():
            setattr(out, name, self.pool.filled(name, view.array(name), dtype))
        given = {"width": width, "background": wp.vec3(*view.background), "samples": samples, "out": out}
        given["rays"] = rays_of(view, self.workspace, bent=program.stretched)
        self._launch(program.resolve, height * width, **given)
        if program.sensor:
            given = {"settings": program.sensor.settings(view, self.pool), "rgb": out.rgb}
            self._launch(program.sensor.kernel, height * width, **given, width=width)
        return WarpImages(images, (height, width), self.launcher, self.stats)

    # helpers

    def _launch(self, kernel: Any, count: int, block: int = BLOCK, **given: Any) -> None:
        self.launcher.launch(kernel, count, {**self.held, **given}, block)

    def _take(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.scratch(name, size, dtype)
        return array

    def _exact(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.exact(name, size, dtype)
        return array
