"""A picture on a Warp device, or those of many views at once: the stages project, sort, bin, blend, resolve.

The view is one more index of every stage: splats, tiles and samples are numbered view after view. The host
reads two numbers between the stages, how many splats are drawn and how many pairs of splats and tiles there
are: they size arrays and launches. A picture with more pairs than the device's budget is drawn in bands of
tiles, with the same bits.

A picture of a kind that was drawn before does not wait for them: it is given `Room`, and its `totals` say
what it would have taken. Where that is more its lists are empty (ahead.py draws it again).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fidsplat.backends.bands import cut
from fidsplat.backends.batched_views import ViewStack
from fidsplat.backends.view import SubFrame, View
from fidsplat.backends.warp.launch import BLOCK, Launcher
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.resident import Resident
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.structs import (
    array_of,
    lens_of,
    memory_bytes,
    moving_of,
    rays_of,
    surroundings_of,
    uniforms,
)
from fidsplat.backends.warp.workspace import ArrayPool, Workspace
from fidsplat.util.errors import DeviceError, bytes_words

# bytes: of one splat's bounds; of its window, keys, counts, drawn, places, sums; of one that is drawn, in
# sort and lists; of a pair with the scratch of its sort
_BOUNDS, _PROJECTED, _VISIBLE, _PAIR = 44, 36, 40, 24


@dataclass(frozen=True)
class Into:
    """Where the images of a picture go."""

    arrays: Mapping[str, Any]
    """by the names of the outputs"""
    slots: Any
    """(views) int32 on the device: place of each view's images in them"""


@dataclass(frozen=True)
class Room:
    """For the lists of a picture."""

    visible: int
    """splats that are drawn"""
    pairs: int
    """of splats and tiles"""


class Picture:
    """The stages in order, each a method."""

    def __init__(
        self,
        program: Program,
        workspace: Workspace,
        resident: Resident,
        stack: ViewStack,
        launcher: Launcher,
        beside: int = 0,
        room: Room | None = None,
        inputs: ArrayPool | None = None,
    ) -> None:
        """
        Args:
            beside: bytes on the device that belong to the picture or batch of which this one is a part.
            room: of its lists, instead of waiting for what they take.
            inputs: holds what the host fills for the views; the workspace's own by default.
        """
        self.program, self.workspace, self.pool = program, workspace, workspace.pool
        self.resident, self.launcher, self.beside, self.room = resident, launcher, beside, room
        self.inputs = inputs or workspace.pool
        self.wp = load()
        view, shape = stack.view, program.shape
        columns, rows = -(-view.width // shape.tile_width), -(-view.height // shape.tile_height)
        self.views, self.splats = len(stack), len(stack) * resident.count
        self.tiles = self.views * rows * columns
        self.grid = rows * shape.tile_height, columns * shape.tile_width
        """of samples of a view"""
        self.held: dict[str, Any] = {}
        """arrays and structs by the names that kernels' signatures have for them"""
        self.bands = 0
        """of tiles, in which it was drawn"""
        self.stats: dict[str, int] = {"splats": resident.count, "visible": 0, "pairs": 0}
        self.turn_to(stack)

    def turn_to(self, stack: ViewStack) -> None:
        """Fills what the stages read of these views, which are of the kind of those before."""
        program, inputs, view = self.program, self.inputs, stack.view
        self.stack, self.view = stack, view
        if view.sub_frames:
            return  # each sub-frame fills its own
        self._fill_views()
        self.held["lens"] = lens_of(view, self.workspace)
        self.held["moving"] = moving_of(self.resident, stack, inputs)
        self.held |= self._planes()
        given = {"sloped": program.sloped, "opaque": program.opaque}
        self._rays = rays_of(view, self.workspace, inputs, **given)
        if program.backdrop:
            self.held["surroundings"] = surroundings_of(view, self.workspace)

    def _fill_views(self) -> None:
        program, count = self.program, self.resident.count
        numbers = uniforms(self.stack, program.shape, count, program.sloped)
        self.held["views"] = self.inputs.filled("views", numbers, kernels("common").View)

    def draw(self) -> None:
        """All stages but the last, which leave `samples`."""
        self.samples = self._exposed() if self.view.sub_frames else self._drawn()

    def _exposed(self) -> Any:
        """All stages but the last of each sub-frame, and what their samples are together."""
        whole = self._samples("exposed")
        beside = self.beside + self._sample_bytes()
        for sub_frame in self.view.sub_frames:
            stack = ViewStack.alone(sub_frame.view)
            part = Picture(self.program, self.workspace, self.resident, stack, self.launcher, beside)
            samples = part._drawn()
            self.launcher.stage("expose")
            self._gather(sub_frame, samples, whole)
            self.stats = {name: max(value, part.stats[name]) for name, value in self.stats.items()}
        self._fill_views()  # where those of the sub-frames stood
        return whole

    def _gather(self, sub_frame: SubFrame, samples: Any, whole: Any) -> None:
        """Add the samples of a sub-frame: light is averaged, other buffers are those of one pose."""
        start, count = sub_frame.top * self.grid[1], sub_frame.view.height * self.grid[1]
        for name in self.program.sample_fields:
            mine, every = getattr(samples, name), getattr(whole, name)
            if name in self.program.expose:
                given = {"weight": sub_frame.weight, "fresh": int(sub_frame.first), "start": start}
                self.launcher.launch(
                    self.program.expose[name], count, {**given, "raw": mine, "exposed": every}
                )
            elif sub_frame.middle:
                self.wp.copy(every, mine, dest_offset=start, count=count)

    def _drawn(self) -> Any:
        """All stages but the last; sample buffers."""
        wp, n, program = self.wp, self.splats, self.program
        self._take("starts", self.tiles + 1, wp.int32)
        self._take("lists", 1, wp.int32)
        self._take("order", 1, wp.int32)
        self._take("bounds", n, kernels("bounds").Bounds)
        self._take("lines", n * program.layout.lines, wp.vec4)
        self.launcher.stage("project")
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
            self._blend(first, end, samples)
        if program.backdrop:
            # here, as sub-frames may look in different directions
            self.launcher.stage("resolve")
            # without the derivatives that blending may have: a struct of another type
            rays = rays_of(self.view, self.workspace, self.inputs)
            count = self.views * self.view.width * self.view.height
            self._launch(program.backdrop, count, rays=rays, color=samples.color)
        self.stats |= {"visible": visible, "pairs": pairs}
        return samples

    # stages

    def _project(self) -> tuple[int, int]:
        wp, n, sort = self.wp, self.splats, self.program.sort
        self._take("windows", n, wp.uint64)
        self._take("keys", n, wp.uint32)
        counts, ends = self._exact("counts", n, wp.int64), self._exact("ends_by_index", n, wp.int64)
        drawn, places = self._exact("drawn", n, wp.int32), self._exact("places", n, wp.int32)
        # not read where all are of one kind
        cloud = {"boxes": drawn, "thickness": self.resident.arrays["opacities"]} | self.resident.arrays
        cloud |= {name: self.held[name] for name in ("coplanar_groups", "plane_keys")}
        self._launch(self.program.project, n, block=self.program.project_block, **cloud)
        wp.utils.array_scan(drawn, places, inclusive=True)
        wp.utils.array_scan(counts, ends, inclusive=True)
        totals = self._take("totals", 2, wp.int64)
        self.launcher.once(sort.sum_up, 1, {**self.held, "splats": n})
        if self.room:
            return self.room.visible, self.room.pairs
        visible, pairs = self.launcher.read_back(totals, self.pool.host("totals", 2, wp.int64))
        return visible, pairs

    def _planes(self) -> dict[str, Any]:
        """Each splat's plane, and the planes' sort keys in these views."""
        wp, table = self.wp, self.resident.group_table
        if table is None or not self.program.layered:
            none = self.pool.scratch("no planes", 1, wp.int32), self.pool.scratch("no keys", 1, wp.float32)
            return {"coplanar_groups": none[0], "plane_keys": none[1], "plane_count": 0}
        keys = table.keys_of(self.stack)
        filled = self.inputs.filled("plane keys", keys.ravel(), wp.float32)
        return {
            "coplanar_groups": self.resident.arrays["coplanar_groups"],
            "plane_keys": filled,
            "plane_count": keys.shape[1],
        }

    def _sort(self, visible: int) -> None:
        """Splats that are drawn by depth, ties by index."""
        # the sort takes the second half as its scratch
        keys = self._take("sorted_keys", 2 * visible, self.wp.uint32)
        order = self._take("order", 2 * visible, self.wp.int32)
        self._launch(self.program.sort.compact, self.splats, room=visible)
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

    def _sample_bytes(self) -> int:
        """What sample buffers take, of the padded grids."""
        sizes = map(self.wp.types.type_size_in_bytes, self.program.sample_fields.values())
        return self.views * self.grid[0] * self.grid[1] * sum(sizes)

    def fits(self, room: Room) -> bool:
        """Whether a picture with this room keeps to the budgets."""
        try:
            return room.pairs <= self._most_pairs(room.visible)
        except DeviceError:
            return False

    def _most_pairs(self, visible: int) -> int:
        """How many pairs may be listed at once within the budgets.

        Raises:
            DeviceError: what else the picture needs is more than the memory budget.
        """
        workspace, resident = self.workspace, self.resident
        # as the stages take them; the sorts have as much again
        each = 16 * self.program.layout.lines + _BOUNDS + _PROJECTED
        fixed = resident.memory_bytes + each * self.splats + _VISIBLE * visible
        fixed += self._sample_bytes() + self.beside + memory_bytes(self.view, workspace)
        pairs = (workspace.memory_budget - fixed) // _PAIR
        if pairs < 1:
            raise DeviceError(
                f"a memory budget of {bytes_words(workspace.memory_budget)} is too small for "
                f"{resident.count} splats in this picture, which take {bytes_words(fixed)} before their "
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
            self._launch(lists.emit, visible, **band, room=visible, pairs=pairs, beyond=self.tiles)
            wp.utils.radix_sort_pairs(tiles, listed, pairs, 0, self.tiles.bit_length())
        self._launch(sort.find_starts, end - first + 1, **band, pairs=pairs)

    def _samples(self, kind: str) -> Any:
        """Sample buffers that blending fills, as one struct; those of another kind are others."""
        samples = self.program.samples_type()
        for name, dtype in self.program.sample_fields.items():
            size = self.views * self.grid[0] * self.grid[1]
            setattr(samples, name, self._take(f"{kind} {name}", size, dtype))
        return samples

    def _blend(self, first: int, end: int, samples: Any) -> None:
        """Draws the tiles of one band."""
        program, shape = self.program, self.program.shape
        planes = self.resident.arrays.get(
            "coplanar_groups", self.held["lists"]
        )  # not read where there are none
        given = {**self.held, "rays": self._rays, "samples": samples, "coplanar_groups": planes}
        area = shape.tile_width * shape.tile_height
        if shape.schedule == "group":
            count = (end - first) * program.blend_block
            self.launcher.once(program.blend, count, given | {"band_first": first}, program.blend_block)
            return
        given["state"] = self._take("state", self.launcher.pieces * area, program.state)
        self.launcher.tiles(program.blend, first, end, area, given)

    def resolve(self, into: Into, launcher: Launcher) -> None:
        """The last stage: images from samples."""
        view, wp, program = self.view, self.wp, self.program
        width, pixels = view.width // view.samples, view.width * view.height // view.samples**2
        out = program.images_type()
        for name, array in into.arrays.items():
            setattr(out, name, array)
        for name in program.cloud_arrays:
            setattr(out, name, self.resident.arrays[name])
        for name, dtype in program.view_arrays.items():
            setattr(out, name, self.inputs.filled(name, array_of(self.stack, name), dtype))
        given = {"views": self.held["views"], "slots": into.slots, "samples": self.samples, "out": out}
        given["background"] = wp.vec3(*view.background)
        given["rays"] = rays_of(view, self.workspace, self.inputs, bent=program.stretched)
        launcher.launch(program.resolve, self.views * pixels, given)
        if program.sensor:
            settings = program.sensor.settings(view, self.inputs)
            given = {"settings": settings, "slots": into.slots, "rgb": into.arrays["rgb"]}
            sizes = {"width": width, "pixels": pixels}
            launcher.launch(program.sensor.kernel, self.views * pixels, given | sizes)

    # helpers

    def _launch(self, kernel: Any, count: int, block: int = BLOCK, **given: Any) -> None:
        self.launcher.launch(kernel, count, {**self.held, **given}, block)

    def _take(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.scratch(name, size, dtype)
        return array

    def _exact(self, name: str, size: int, dtype: Any) -> Any:
        self.held[name] = array = self.pool.exact(name, size, dtype)
        return array


def view_bytes(program: Program, resident: Resident, view: View) -> tuple[int, int]:
    """What a view of a batch takes beside its images and its lists, and its samples."""
    shape = program.shape
    columns, rows = -(-view.width // shape.tile_width), -(-view.height // shape.tile_height)
    samples = rows * columns * shape.tile_width * shape.tile_height
    sizes = map(load().types.type_size_in_bytes, program.sample_fields.values())
    splat = 16 * program.layout.lines + _BOUNDS + _PROJECTED + _VISIBLE
    return resident.count * splat + samples * sum(sizes), samples
