"""The stages of a frame with one or many views: project, bin, sort, blend, resolve.

Splats, tiles and samples of all views are numbered consecutively, view after view. After projection the host
reads the number of (splat, tile) pairs, which is the size of the lists. A frame with more pairs than the
memory budget allows is rendered in ranges of tiles. A frame like an earlier one does not wait for this
number: its lists have the capacity that earlier frames needed, and are empty if `totals` on the device
exceeds it; pipeline.py then renders the frame again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.ranges import split_by_cost
from fidsplat.backends.view import SubFrame
from fidsplat.backends.warp.cloud import WarpCloud
from fidsplat.backends.warp.command_list import BLOCK, Launcher
from fidsplat.backends.warp.memory_plan import MemoryPlanner
from fidsplat.backends.warp.program import Program
from fidsplat.backends.warp.runtime import kernels, load
from fidsplat.backends.warp.uniforms import array_of, environment_of, lens_of, moving_of, rays_of, uniforms
from fidsplat.backends.warp.workspace import ArrayPool
from fidsplat.util.errors import DeviceError


@dataclass(frozen=True)
class ImageArrays:
    """Output arrays of a frame."""

    allocate: Callable[[], Mapping[str, Any]]
    """returns arrays by the names of the outputs, the same at each call"""
    indices: Any
    """(views,) int32 on the device: batch index of each view in these arrays"""
    reserved: int
    """size in bytes of the images of all views of the batch"""


class DeviceFrame:
    """State of a frame: its arrays, and a method for each stage."""

    def __init__(
        self,
        program: Program,
        planner: MemoryPlanner,
        cloud: WarpCloud,
        batch: ViewBatch,
        launcher: Launcher,
        reserved: int = 0,
        capacity: int | None = None,
        inputs: ArrayPool | None = None,
    ) -> None:
        """reserved: bytes of the frame or batch that contains this frame. capacity: pairs for which the
        lists have capacity; None: the host waits for their number. inputs: pool of the arrays that the host
        fills for the views."""
        self.program, self.planner, self.workspace = program, planner, planner.workspace
        self.pool = self.workspace.pool
        self.cloud, self.launcher = cloud, launcher
        self.reserved, self.capacity = reserved, capacity
        self.inputs = inputs or self.pool
        self.wp = load()
        view, config = batch.view, program.config
        columns, rows = -(-view.width // config.tile_width), -(-view.height // config.tile_height)
        self.view_count, self.splats = len(batch), len(batch) * cloud.count
        self.tiles = self.view_count * rows * columns
        self.grid = rows * config.tile_height, columns * config.tile_width
        """rows and columns of samples of a view"""
        self.named: dict[str, Any] = {}
        """arrays and structs by the names of the kernels' parameters"""
        self.tile_ranges = 0
        """number of ranges of tiles in which the frame was rendered"""
        self.stats: dict[str, int] = {"splats": cloud.count, "visible": 0, "pairs": 0}
        self.set_views(batch)

    def set_views(self, batch: ViewBatch) -> None:
        """Fill the input arrays and structs for other views with the same size and effects."""
        program, inputs, view = self.program, self.inputs, batch.view
        self.batch, self.view = batch, view
        if view.sub_frames:
            return  # each sub-frame fills its own inputs
        self._fill_views()
        self.named["lens"] = lens_of(view, self.workspace)
        self.named["moving"] = moving_of(self.cloud, batch, inputs)
        arguments = {
            "has_ray_derivatives": program.has_ray_derivatives,
            "has_external_depth": program.has_external_depth,
        }
        self._rays = rays_of(view, self.workspace, inputs, **arguments)
        if program.composite_background:
            self.named["environment"] = environment_of(view, self.workspace)

    def _fill_views(self) -> None:
        program, count = self.program, self.cloud.count
        numbers = uniforms(self.batch, program.config, count, program.has_ray_derivatives)
        self.named["views"] = self.inputs.filled("views", numbers, kernels("common").View)

    def render(self) -> None:
        """Run all stages except resolve; results are in `samples`."""
        self.samples = self._render_exposure() if self.view.sub_frames else self._render_pose()

    def _render_exposure(self) -> Any:
        """Run all stages except resolve for each sub-frame, and accumulate their samples."""
        accumulated = self._samples("accumulated")
        reserved = self.reserved + self.planner.sample_bytes(self.view)
        for sub_frame in self.view.sub_frames:
            batch = ViewBatch.single(sub_frame.view)
            part = DeviceFrame(self.program, self.planner, self.cloud, batch, self.launcher, reserved)
            samples = part._render_pose()
            self.launcher.stage("accumulate")
            self._accumulate(sub_frame, samples, accumulated)
            self.stats = {name: max(value, part.stats[name]) for name, value in self.stats.items()}
        self._fill_views()  # sub-frames have overwritten the inputs
        return accumulated

    def _accumulate(self, sub_frame: SubFrame, samples: Any, accumulated: Any) -> None:
        """Add the samples of a sub-frame: colours are averaged, other buffers are from the middle pose."""
        start, count = sub_frame.top * self.grid[1], sub_frame.view.height * self.grid[1]
        for name in self.program.sample_fields:
            source, target = getattr(samples, name), getattr(accumulated, name)
            if name in self.program.accumulate:
                arguments = {
                    "weight": sub_frame.weight,
                    "first_sub_frame": int(sub_frame.first),
                    "start": start,
                }
                self.launcher.launch(
                    self.program.accumulate[name], count, {**arguments, "raw": source, "accumulated": target}
                )
            elif sub_frame.middle:
                self.wp.copy(target, source, dest_offset=start, count=count)

    def _render_pose(self) -> Any:
        """Run all stages except resolve for one pose; returns the sample buffers."""
        wp, n, program = self.wp, self.splats, self.program
        for name, size in {"starts": 1, "cursors": 0, "tile_order": 0}.items():
            self._scratch(name, self.tiles + size, wp.int32)
        self._scratch("bounds", n, kernels("bounds").Bounds)
        self._scratch("records", n * program.layout.vec4s, wp.vec4)
        self.launcher.stage("project")
        visible, pairs = self._project()
        samples = self._samples("raw")
        for first, end, listed in self._tile_ranges(pairs):
            self.tile_ranges += 1
            self.launcher.stage("bin")
            self._bin(first, end, listed, complete=listed == pairs)
            self.launcher.stage("sort")
            self.launcher.launch_blocks(self.program.lists.sort_lists, first, end, self.named)
            self.launcher.stage("blend")
            self._blend(first, end, samples)
        if program.composite_background:
            # set here, as sub-frames may have other directions
            self.launcher.stage("resolve")
            # rays without derivatives: another struct type than for blending
            rays = rays_of(self.view, self.workspace, self.inputs)
            count = self.view_count * self.view.width * self.view.height
            self._launch(program.composite_background, count, rays=rays, color=samples.color)
        self.stats |= {"visible": visible, "pairs": pairs}
        return samples

    # stages

    def _project(self) -> tuple[int, int]:
        """Project, and count the pairs of each tile. Returns the numbers of visible splats and of pairs, or
        the capacity."""
        wp, n, first_tile = self.wp, self.splats, self.program.lists.COUNTERS
        self._scratch("windows", n, wp.uint64)
        self._scratch("keys", n, wp.uint32)
        self._scratch("big", n, wp.int32)
        self._scratch("pairs", 1, wp.uint64)
        counts = self._exact("counts", n, wp.int32)
        counters = self._exact("counters", first_tile + self.tiles, wp.int32)
        totals = self._scratch("totals", 2, wp.int64)
        counters.zero_()
        # placeholders, which kernels do not read if all splats have one primitive
        arrays = {"boxes": counts, "coplanar_groups": counts, "thickness": self.cloud.arrays["opacities"]}
        arrays |= self.cloud.arrays
        if n:
            self._launch(self.program.project, n, block=self.program.project_block, **arrays)
            self._list_big({"cursors": counters, "first_cursor": first_tile, "capacity": 0})
        unlimited = 2**31 - 1
        self._start_lists(0, self.tiles, unlimited if self.capacity is None else self.capacity)
        if self.capacity is not None:
            return 0, self.capacity
        visible, pairs = self.launcher.read_back(totals, self.pool.host("totals", 2, wp.int64))
        return visible, pairs

    def _list_big(self, arguments: dict[str, Any], first: int = 0, end: int | None = None) -> None:
        """Count or list the tiles of big splats."""
        blocks = 8 * self.pool.device.sm_count if self.pool.device.is_cuda else 64
        tiles = {"first_tile": first, "end_tile": self.tiles if end is None else end, "blocks": blocks}
        self.launcher.launch_blocks(self.program.list_big, 0, blocks, self.named | tiles | arguments)

    def _start_lists(self, first: int, end: int, capacity: int) -> None:
        """Compute the starts of the lists of a range of tiles."""
        arguments, lists = {"end_tile": end, "capacity": capacity}, self.program.lists
        self.launcher.launch_blocks(
            lists.start_lists, first, first + 1, self.named | arguments, lists.START_BLOCK
        )

    def _tile_ranges(self, pairs: int) -> Iterator[tuple[int, int, int]]:
        """Split the tiles into ranges (first, end, pairs) whose lists fit the budgets; usually one."""
        limit = self.planner.max_pairs(self.cloud, self.batch, self.reserved)
        if pairs <= limit:
            return iter([(0, self.tiles, pairs)])
        lengths = self.named["counters"].numpy()[self.program.lists.COUNTERS :]
        return split_by_cost(lengths[: self.tiles], limit)

    def fits(self, capacity: int) -> bool:
        """Whether a frame with this number of pairs fits the budgets in one range of tiles."""
        try:
            return capacity <= self.planner.max_pairs(self.cloud, self.batch, self.reserved)
        except DeviceError:
            return False

    def _bin(self, first: int, end: int, pairs: int, complete: bool) -> None:
        """Write the pairs of a range of tiles. complete: whether it has all tiles."""
        self._scratch("pairs", pairs, self.wp.uint64)
        self._scratch("lists", pairs, self.wp.int32)
        if not complete:
            self._start_lists(first, end, pairs)
        tiles = {"first_tile": first, "end_tile": end, "capacity": pairs, "splats": self.splats}
        if self.splats:
            self._list_big({"first_cursor": 0, "capacity": pairs}, first, end)
            # complete blocks
            self._launch(self.program.lists.list_windows, -(-self.splats // BLOCK) * BLOCK, **tiles)

    def _samples(self, kind: str) -> Any:
        samples = self.program.samples_type()
        for name, dtype in self.program.sample_fields.items():
            size = self.view_count * self.grid[0] * self.grid[1]
            setattr(samples, name, self._scratch(f"{kind} {name}", size, dtype))
        return samples

    def _blend(self, first: int, end: int, samples: Any) -> None:
        program, config = self.program, self.program.config
        # a placeholder, which kernels do not read
        groups = self.cloud.arrays.get("coplanar_groups", self.named["lists"])
        arguments = {**self.named, "rays": self._rays, "samples": samples, "coplanar_groups": groups}
        area = config.tile_width * config.tile_height
        if config.schedule == "group":
            count = (end - first) * program.blend_block
            self.launcher.launch_undivided(
                program.blend, count, arguments | {"first_tile": first}, program.blend_block
            )
            return
        arguments["state"] = self._scratch("state", self.launcher.parts * area, program.state)
        self.launcher.launch_blocks(program.blend, first, end, arguments, area=area)

    def resolve(self, into: ImageArrays, launcher: Launcher) -> None:
        """Run the resolve stage: images from samples."""
        launcher.stage("resolve")
        view, wp, program = self.view, self.wp, self.program
        width, pixels = view.width // view.samples, view.width * view.height // view.samples**2
        out = program.images_type()
        arrays = into.allocate()
        for name, array in arrays.items():
            setattr(out, name, array)
        for name in program.cloud_arrays:
            setattr(out, name, self.cloud.arrays[name])
        for name, dtype in program.view_arrays.items():
            setattr(out, name, self.inputs.filled(name, array_of(self.batch, name), dtype))
        arguments = {
            "views": self.named["views"],
            "batch_indices": into.indices,
            "samples": self.samples,
            "out": out,
        }
        arguments["background"] = wp.vec3(*view.background)
        arguments["rays"] = rays_of(view, self.workspace, self.inputs, has_lens=program.has_ray_lengths)
        launcher.launch(program.resolve, self.view_count * pixels, arguments)
        if program.sensor:
            settings = program.sensor.settings(view, self.inputs)
            arguments = {"settings": settings, "batch_indices": into.indices, "rgb": arrays["rgb"]}
            sizes = {"width": width, "pixels": pixels}
            launcher.launch(program.sensor.kernel, self.view_count * pixels, arguments | sizes)
        launcher.stage(None)

    # helpers

    def _launch(self, kernel: Any, count: int, block: int = BLOCK, **arguments: Any) -> None:
        self.launcher.launch(kernel, count, {**self.named, **arguments}, block)

    def _scratch(self, name: str, size: int, dtype: Any) -> Any:
        self.named[name] = array = self.pool.scratch(name, size, dtype)
        return array

    def _exact(self, name: str, size: int, dtype: Any) -> Any:
        self.named[name] = array = self.pool.exact(name, size, dtype)
        return array
