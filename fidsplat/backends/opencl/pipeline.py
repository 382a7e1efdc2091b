"""The stages compiled for one FeatureSet on one device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch, ViewStack
from fidsplat.backends.opencl.assemble import Source
from fidsplat.backends.opencl.batch import OpenCLBatch, OutputBuffers, parts
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.drawing import Slots, draw
from fidsplat.backends.opencl.images import Drawn, OpenCLImages, Repeat, stats_later
from fidsplat.backends.opencl.lists import GatheredLists, TiledLists
from fidsplat.backends.opencl.memory_plan import (
    BIG,
    KEYS,
    SMALL,
    SORTED,
    WINDOWS,
    MemoryPlan,
    plan_of,
    table_bytes,
)
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.recording import Recording
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.backends.opencl.workspace import RayBuffers, Workspace
from fidsplat.backends.view import View
from fidsplat.cameras.raster import RayRaster
from fidsplat.effects import FeatureSet
from fidsplat.util.errors import DeviceError

_OF_CAMERAS = ("ray", "vignette_center")
"""groups of uniforms that differ where cameras do"""
_KINDS = 32
"""of pictures of one cloud that are kept"""
_RASTERS = 4
"""of lenses among them: as many as `raster_of` keeps"""


@dataclass
class Kept:
    """What is kept of a kind of picture that was drawn before."""

    plan: MemoryPlan
    kind: tuple[Any, ...]
    """for `BufferPool.make_way`"""
    raster: RayRaster | None
    """whose rays stay on the device as long as it is kept"""
    recording: Recording | None = None


class OpenCLPipeline:
    """Compiled stages."""

    def __init__(
        self,
        workspace: Workspace,
        source: Source,
        features: FeatureSet,
        shape: DeviceShape,
        other: Callable[[FeatureSet, DeviceShape], OpenCLPipeline],
    ) -> None:
        self.workspace, self.source, self.features, self.shape = workspace, source, features, shape
        self.program = Program(workspace, source)
        self._commands = CommandList(self.program)
        """of frames that are not replayed"""
        arguments = source.arguments
        self._cloud_arrays = [one.name for one in arguments["project"] if one.source == "cloud"]
        self._view_arrays = {one.name for each in arguments.values() for one in each if one.source == "array"}
        self._slopes = any(one.name == "ray_slopes" for one in arguments["blend"])
        self._other = other
        """gives the pipeline of another shape"""

    def render(self, resident: Resident, view: View) -> OpenCLImages:
        """Draw one picture. One of a kind that was drawn before is launched without waiting for the device.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        workspace = self.workspace
        with workspace.lock:
            # launches are kept of whole pictures alone
            key = self._kind(view) if view.band is None else None
            kept = resident.kept.get(key)
            if kept is not None and (repeated := self._tried(self._repeat, resident, view, kept)) is not None:
                return repeated
            if resident.neighbours and self.shape.lists == "tiled":
                gathered = replace(self.shape, lists="gathered")
                return self._other(self.features, gathered).render(resident, view)
            plan = self._plan(resident, view)
            if plan.chunk and self.shape.lists != "ordered":
                # one way of drawing in chunks is enough: where memory is short, sorting takes the least time
                return self._other(self.features, replace(self.shape, lists="ordered")).render(resident, view)
            return self._images(view, Drawn.of(self._tried(self._first, resident, view, plan, key)))

    def fits(self, resident: Resident, view: View) -> bool:
        """As `KnowsRoom`."""
        try:
            return not self._plan(resident, view).chunk
        except DeviceError:  # too little memory for any part of it
            return False

    def drawn(
        self, resident: Resident, view: View, trusted: int = 0, commands: CommandList | None = None
    ) -> tuple[Picture, OpenCLImages]:
        """One picture with all that its stages have left on the device, until another is drawn.

        trusted: as `Picture` has it; `pairs_of` then says whether all was drawn. commands: records what is
        launched, for replay.

        Raises:
            DeviceError: as `render`.
        """
        with self.workspace.lock:
            picture = self._tried(self._whole, resident, view, trusted, commands)
            return picture, self._images(view, Drawn.of(picture))

    def drawn_by(
        self, launch: Callable[[], Picture | None], view: View
    ) -> tuple[Picture, OpenCLImages] | None:
        """As `drawn`, by who launches it (`lock` held); None where nothing was launched."""
        picture = self._tried(launch)
        return None if picture is None else (picture, self._images(view, Drawn.of(picture)))

    def _whole(self, resident: Resident, view: View, trusted: int, commands: CommandList | None) -> Picture:
        """A picture that is drawn at once, not in chunks or bands."""
        plan = self._plan(resident, view)
        picture = None
        if not plan.chunk:
            picture = self._first(resident, view, plan, trusted=trusted, commands=commands)
        if picture is None or picture.pairs > self.workspace.pair_budget:
            raise DeviceError(
                f"{resident.count:,} splats are drawn in chunks or bands within the memory budget, and such "
                "pictures have no gradient; raise memory_budget, or use fewer splats or smaller pictures"
            )
        return picture

    def render_batch(self, resident: Resident, batch: ViewBatch) -> OpenCLBatch:
        """Draw many views, as many at once as memory holds.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        with self.workspace.lock:
            return self._tried(self._batch, resident, batch)

    def _batch(self, resident: Resident, batch: ViewBatch) -> OpenCLBatch:
        workspace, pool, outputs = self.workspace, self.workspace.pool, self.features.images
        workspace.turn_to(workspace.queue)
        buffers = OutputBuffers(workspace, outputs, batch)
        drawn: list[Drawn] = []
        for first, end, plan in self._parts(resident, batch, buffers.nbytes):
            views = batch.views
            stack = views.part(first, end) if isinstance(views, ViewStack) and end - first > 1 else None
            shape = self._listing(resident, plan, stack)
            pipeline = self if shape is self.shape else self._other(self.features, shape)
            pool.make_way((pipeline, "views", resident.room, plan), workspace.memory_budget - plan.held)

            def start(view: View, pipeline=pipeline, stack=stack, plan=plan) -> Picture:
                return Picture(
                    workspace, pipeline._commands, pipeline.shape, resident, view, plan, stack=stack
                )

            into = Slots(batch.slots[first:end].copy(), buffers.held())
            drawn.append(Drawn.of(draw(start, batch.one(first), outputs, into)))
        return OpenCLBatch(workspace, buffers, drawn, resident.count)

    def _listing(self, resident: Resident, plan: MemoryPlan, stack: ViewStack | None) -> DeviceShape:
        """The shape that lists a part of a batch in the least time."""
        if self.shape.lists != "tiled":
            return self.shape
        if plan.chunk:
            return replace(self.shape, lists="ordered")  # as `render`
        few = stack is not None and self._tiles(stack.view) <= GatheredLists.TILES
        return replace(self.shape, lists="gathered") if few or resident.neighbours else self.shape

    def _tiles(self, view: View) -> int:
        """That a view has."""
        return -(-view.width // self.shape.tile_width) * -(-view.height // self.shape.tile_height)

    def _parts(
        self, resident: Resident, batch: ViewBatch, beside: int
    ) -> Iterator[tuple[int, int, MemoryPlan]]:
        """Ranges of views (first, end) that are drawn at once, and what they may hold. beside: bytes of all
        output images."""
        count, views, budget = len(batch.slots), batch.views, self.workspace.memory_budget
        if not count:
            return
        plan = self._plan(resident, batch.one(0), beside)
        if plan.chunk or not (isinstance(views, ViewStack) and self._goes_together(resident, views)):
            yield from ((k, k + 1, self._plan(resident, batch.one(k), beside)) for k in range(count))
            return
        each, samples = self._bytes_of_view(resident, views.view)
        # no buffer may be larger than the device gives in one piece
        free = min(budget - plan.held + each, self.workspace.device.max_mem_alloc_size)
        for first, end in parts(count, each, samples, self.workspace.info.kind, free):
            yield first, end, MemoryPlan(0, resident.count, plan.held + (end - first - 1) * each)

    def _goes_together(self, resident: Resident, stack: ViewStack) -> bool:
        """Whether all that differs from view to view stands in the record `View`."""
        arguments = self.source.arguments
        every = [one for each in arguments.values() for one in each]
        if resident.streamed or "backdrop" in arguments or any(one.source == "array" for one in every):
            return False
        if any(one.name == "rays" for one in arguments.get("resolve", ())):
            return False
        return not (stack.numbers and any(one.uniform[0] in _OF_CAMERAS for one in every))

    def _bytes_of_view(self, resident: Resident, view: View) -> tuple[int, int]:
        """What a view of a batch takes beside its images, and its samples."""
        shape, source = self.shape, self.source
        tiles = self._tiles(view)
        samples = tiles * shape.tile_width * shape.tile_height
        splat = source.records["Splat"].itemsize + KEYS + WINDOWS
        splat += SORTED if shape.lists == "ordered" else 0
        channels = 4 + sum(one.channels for one, _ in source.samples)
        tables = table_bytes(shape.lists, tiles, shape.chunks, shape.radix_bits)
        return resident.room * splat + tables + 4 * channels * samples, samples

    def _kind(self, view: View) -> tuple[Any, ...]:
        """What pictures have in common whose launches differ in numbers alone."""
        labels = tuple(label for label, _ in view.groups)
        budgets = self.workspace.memory_budget, self.workspace.pair_budget
        return self, view.width, view.height, view.raster, labels, budgets

    def _tried(self, work: Callable[..., Any], *given: Any) -> Any:
        """Calls it; leaves the device idle if it fails."""
        try:
            return work(*given)
        except BaseException as error:
            workspace = self.workspace
            workspace.pool.forget_zeros()
            for queue in (workspace.queue, workspace.repeat_queue):
                with suppress(cl.Error):
                    queue.finish()  # a CPU may be reading the arrays of a cloud that nobody keeps
            if isinstance(error, cl.Error):
                raise DeviceError(f"{workspace.info.title} failed while drawing: {error}") from error
            raise

    def _images(self, view: View, drawn: Drawn, repeat: Repeat | None = None) -> OpenCLImages:
        size = view.height // view.samples, view.width // view.samples
        tile = self.shape.tile_height, self.shape.tile_width
        tiles = (-(-view.height // tile[0]), -(-view.width // tile[1])), tile
        outputs = self.features.images
        return OpenCLImages(self.workspace, outputs, size, drawn, repeat, tiles, view.samples)

    def _first(
        self,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
        key: tuple[Any, ...] | None = None,
        trusted: int = 0,
        commands: CommandList | None = None,
    ) -> Picture:
        """Draws a picture with what room it takes; remembers its kind, if the next may be launched again."""
        pool = self.workspace.pool
        alike = resident.alike if not plan.chunk else None
        kind = self, view.width, view.height, alike or (resident.room, plan)
        # what this picture takes besides is planned for; that of its own kind is there already
        pool.make_way(kind, self.workspace.memory_budget - plan.held, resident.room)
        picture = self._draw(resident, view, plan, trusted, commands)
        whole = not (plan.chunk or resident.streamed or view.sub_frames or picture.in_bands)
        if key is not None and whole and self.shape.lists != "ordered" and resident.count:
            rasters = {each.raster for each in resident.kept.values()} - {None, view.raster}
            if len(resident.kept) >= _KINDS or (view.raster is not None and len(rasters) >= _RASTERS):
                resident.kept.clear()
            resident.kept[key] = Kept(plan, kind, view.raster)
        return picture

    def _repeat(self, resident: Resident, view: View, kept: Kept) -> OpenCLImages | None:
        """The next picture of a kind; None where nothing is left of the last."""
        workspace, plan = self.workspace, kept.plan
        workspace.pool.make_way(kept.kind, workspace.memory_budget - plan.held, resident.room)
        if not TiledLists.capacity(workspace):
            return None
        queue, recording = workspace.turn_to(workspace.repeat_queue), kept.recording
        workspace.pictures += 1

        commands = CommandList(self.program) if recording is None else recording.commands

        def undrawn(view: View) -> Picture:
            return Picture(workspace, commands, self.shape, resident, view, plan, queue)

        if recording is not None and recording.fits(view, undrawn, queue):
            leased, events = recording.launch(queue)
            stats = stats_later(workspace, dict(leased)["counts"], events[-1], resident.count)
            drawn = Drawn(queue, leased, stats, events[-1])
        else:
            kept.recording = None  # an interrupt leaves a part of one
            picture = draw(undrawn, view, self.features.images)
            drawn = Drawn.of(picture, timed=False)
            recording = kept.recording = Recording(picture)
        repeat = Repeat(self._redrawn, self._timed, workspace, resident, view, recording)
        images = self._images(view, drawn, repeat)
        if not resident.fixed:
            images.settle()
        return images

    def _timed(self, resident: Resident, view: View, recording: Recording) -> dict[str, float]:
        """Milliseconds of the stages, of the picture drawn once more."""
        return self._tried(self._drawn_for_time, resident, view, recording).timings()

    def _drawn_for_time(self, resident: Resident, view: View, recording: Recording) -> Drawn:
        workspace = self.workspace
        queue = workspace.turn_to(workspace.queue)
        workspace.pictures += 1

        def undrawn(view: View) -> Picture:
            plan = MemoryPlan(0, 0, 0)
            return Picture(workspace, recording.commands, self.shape, resident, view, plan, queue)

        if recording.fits(view, undrawn, queue):
            leased, events = recording.launch(queue)
            stages = recording.commands.stages
            drawn = Drawn(queue, leased, dict, events[-1], list(zip(stages, events, strict=True)))
        else:
            drawn = self._redrawn(resident, view)
        workspace.finish()
        workspace.pool.give_back(drawn.leased)
        return drawn

    def _redrawn(self, resident: Resident, view: View) -> Drawn:
        """The picture drawn again, whatever it takes, and its time."""
        return Drawn.of(self._tried(self._first, resident, view, self._plan(resident, view)))

    def _draw(
        self,
        resident: Resident,
        view: View,
        plan: MemoryPlan,
        trusted: int = 0,
        commands: CommandList | None = None,
    ) -> Picture:
        commands = self._commands if commands is None else commands

        def start(view: View) -> Picture:
            return Picture(self.workspace, commands, self.shape, resident, view, plan, trusted=trusted)

        return draw(start, view, self.features.images)

    def _plan(self, resident: Resident, view: View, beside: int = 0) -> MemoryPlan:
        """beside: bytes that something else holds meanwhile."""
        shape, source = self.shape, self.source
        tiles_x = -(-view.width // shape.tile_width)
        tiles = tiles_x * -(-view.height // shape.tile_height)
        stays, upload = resident.bytes_for(self._cloud_arrays)
        fixed = beside + stays + SMALL + table_bytes(shape.lists, tiles, shape.chunks, shape.radix_bits)
        fixed += BIG * (4 + source.records["Bounds"].itemsize)
        channels = 4 + sum(one.channels for one, _ in source.samples)
        if view.sub_frames:
            channels *= 2  # the picture's own beside those of a sub-frame
        fixed += 4 * tiles * shape.tile_width * shape.tile_height * channels  # whole tiles
        pixels = view.width * view.height // view.samples**2
        fixed += 4 * pixels * sum(output.channels for output in self.features.images)
        fixed += sum(view.array(name).nbytes for name in self._view_arrays)
        if view.raster is not None:
            rasters = {
                view.raster,
                *(sub_frame.view.raster for sub_frame in view.sub_frames if sub_frame.view.raster),
            }
            columns = tiles_x * shape.tile_width
            fixed += RayBuffers.bytes_of(rasters, shape.tile_height, columns, self._slopes)
        workspace, record = self.workspace, source.records["Splat"].itemsize
        budget, largest = workspace.memory_budget, workspace.device.max_mem_alloc_size
        return plan_of(resident.room, record, upload, fixed, shape.lists, budget, largest)

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; starts (tiles + 1,) uint32; lists (pairs,) uint32, of the last band; records (n,) of
        the record `Splat` (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the padded sample grid; and the finished outputs by name.
        """
        picture = self._draw(resident, view, MemoryPlan(0, resident.count, 0))
        made = self._images(view, Drawn.of(picture))
        return {
            "keys": picture.read("keys", np.uint32, (resident.count,)),
            "starts": picture.read("starts", np.uint32, (picture.tiles + 1,)),
            "lists": picture.read("lists", np.uint32, (made.stats["pairs"],)),
            "records": picture.read("splats", self.source.records["Splat"], (resident.count,)),
            "raw": picture.read("raw", np.float32, (4, picture.rows, picture.stride)),
            **{output.name: made.read(output.name) for output in self.features.images},
        }
