"""The stages compiled for one FeatureSet on one device, and the output images that they make."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import Source
from fidsplat.backends.opencl.drawing import Images, draw
from fidsplat.backends.opencl.memory_plan import BIG, SMALL, MemoryPlan, plan_of, table_bytes
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.opencl.program import Program
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.backends.opencl.workspace import RayBuffers, Workspace
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.errors import DeviceError


class OpenCLImages:
    """Output images on the device, with the events of the kernels that made them.

    Their buffers go back to the pool when nobody holds the images any more.
    """

    def __init__(self, picture: Picture, images: Images) -> None:
        # not the picture itself, which holds the cloud and all scratch buffers
        self._queue, self._images, self._events = picture.queue, images, picture.events
        self._stats, self._title = picture.stats, picture.workspace.info.title
        self._uploads = picture.uploads  # kept until the device has read them
        view = picture.view
        self._size = (view.height // view.samples, view.width // view.samples)
        weakref.finalize(self, picture.pool.give_back, picture.leased)

    def read(self, name: str) -> np.ndarray:
        """The image on the host; waits for the device.

        Raises:
            DeviceError: the device has failed, in this or while it was drawing.
        """
        output, buffer = self._images[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        image = np.empty(shape, output.dtype)
        try:
            cl.enqueue_copy(self._queue, image, buffer)
        except cl.Error as error:
            raise DeviceError(f"{self._title} failed while drawing {name}: {error}") from error
        return image

    @property
    def timings(self) -> dict[str, float]:
        self._queue.finish()
        timings: dict[str, float] = {}
        for stage, event in self._events:
            timings[stage] = timings.get(stage, 0.0) + (event.profile.end - event.profile.start) * 1e-6
        return timings

    @property
    def stats(self) -> Mapping[str, int]:
        return self._stats()


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
        arguments = source.arguments
        self._cloud_arrays = [one.name for one in arguments["project"] if one.source == "cloud"]
        self._view_arrays = {one.name for each in arguments.values() for one in each if one.source == "array"}
        self._slopes = any(one.name == "ray_slopes" for one in arguments["blend"])
        self._other = other
        """gives the pipeline of another shape"""

    def render(self, resident: Resident, view: View) -> OpenCLImages:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        return OpenCLImages(*self.drawn(resident, view))

    def drawn(self, resident: Resident, view: View) -> tuple[Picture, Images]:
        """One picture with all that its stages have left on the device, until another is drawn.

        Raises:
            DeviceError: as `render`.
        """
        plan = self._plan(resident, view)
        if plan.chunk and self.shape.lists != "ordered":
            # one way of drawing in chunks is enough: where memory is short, sorting takes the least time
            return self._other(self.features, replace(self.shape, lists="ordered")).drawn(resident, view)
        workspace = self.workspace
        way = workspace.memory_budget - plan.held
        # what this picture takes anew is planned for; that of its own kind is there already
        workspace.pool.make_way((self, view.width, view.height, resident.count, plan), way)
        try:
            return self._draw(resident, view, plan)
        except BaseException as error:
            with suppress(cl.Error):
                workspace.queue.finish()  # a CPU may be reading the arrays of a cloud that nobody keeps
            if isinstance(error, cl.Error):
                raise DeviceError(f"{workspace.info.title} failed while drawing: {error}") from error
            raise

    def _draw(self, resident: Resident, view: View, plan: MemoryPlan) -> tuple[Picture, Images]:
        def start(view: View) -> Picture:
            return Picture(self.workspace, self.program, self.shape, resident, view, plan)

        return draw(start, view, self.features.images)

    def _plan(self, resident: Resident, view: View) -> MemoryPlan:
        shape, source = self.shape, self.source
        tiles_x = -(-view.width // shape.tile_width)
        tiles = tiles_x * -(-view.height // shape.tile_height)
        stays, upload = resident.bytes_for(self._cloud_arrays)
        fixed = stays + SMALL + table_bytes(shape.lists, tiles, shape.chunks, shape.radix_bits)
        fixed += BIG * (4 + source.records["Bounds"].itemsize)
        channels = 4 + sum(one.channels for one, _ in source.samples)
        if view.shots:
            channels *= 2  # the picture's own beside those of a shot
        fixed += 4 * tiles * shape.tile_width * shape.tile_height * channels  # whole tiles
        pixels = view.width * view.height // view.samples**2
        fixed += 4 * pixels * sum(output.channels for output in self.features.images)
        fixed += sum(view.array(name).nbytes for name in self._view_arrays)
        if view.raster is not None:
            rasters = {view.raster, *(shot.view.raster for shot in view.shots if shot.view.raster)}
            columns = tiles_x * shape.tile_width
            fixed += RayBuffers.bytes_of(rasters, shape.tile_height, columns, self._slopes)
        workspace, record = self.workspace, source.records["Splat"].itemsize
        budget, largest = workspace.memory_budget, workspace.device.max_mem_alloc_size
        return plan_of(resident.count, record, upload, fixed, shape.lists, budget, largest)

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; starts (tiles + 1,) uint32; lists (pairs,) uint32, of the last band; records (n,) of
        the record `Splat` (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the padded sample grid; and the finished outputs by name.
        """
        picture, images = self._draw(resident, view, MemoryPlan(0, resident.count, 0))
        made = OpenCLImages(picture, images)
        return {
            "keys": picture.read("keys", np.uint32, (resident.count,)),
            "starts": picture.read("starts", np.uint32, (picture.tiles + 1,)),
            "lists": picture.read("lists", np.uint32, (made.stats["pairs"],)),
            "records": picture.read("splats", self.source.records["Splat"], (resident.count,)),
            "raw": picture.read("raw", np.float32, (4, picture.rows, picture.stride)),
            **{output.name: made.read(output.name) for output in self.features.images},
        }
