"""The stages compiled for one FeatureSet on one device, and the planes that they make."""

from __future__ import annotations

import weakref
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import DeviceShape, Source
from fidsplat.backends.opencl.exposed_run import ExposedRun
from fidsplat.backends.opencl.lists import SPLAT_ARRAYS
from fidsplat.backends.opencl.memory import DeviceBuffer, Resident
from fidsplat.backends.opencl.plan import BIG, SMALL, Plan, plan_of, table_bytes
from fidsplat.backends.opencl.ray_buffers import RayBuffers
from fidsplat.backends.opencl.run import Run
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.effects.catalogue import Output
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.backend import OpenCLBackend


class OpenCLPlanes:
    """Finished planes on the device, with the events of the kernels that made them.

    Their buffers go back to the pool when nobody holds the planes any more.
    """

    def __init__(self, run: Run, outputs: dict[str, tuple[Output, cl.Buffer]]) -> None:
        # not the run itself, which holds the cloud and all scratch buffers
        self._queue, self._outputs, self._events = run.queue, outputs, run.events
        self._stats, self._title = run.stats, run.backend.info.title
        self._uploads = run.uploads  # kept until the device has read them
        self._size = (run.view.height // run.view.samples, run.view.width // run.view.samples)
        weakref.finalize(self, run.pool.give_back, run.leased)

    def read(self, name: str) -> np.ndarray:
        """The plane on the host; waits for the device.

        Raises:
            DeviceError: the device has failed, in this or while it was drawing.
        """
        output, buffer = self._outputs[name]
        shape = self._size if output.channels == 1 else (*self._size, output.channels)
        plane = np.empty(shape, output.dtype)
        try:
            cl.enqueue_copy(self._queue, plane, buffer)
        except cl.Error as error:
            raise DeviceError(f"{self._title} failed while drawing {name}: {error}") from error
        return plane

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
        self._kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
        self._bound: dict[str, list] = {}
        taken = [
            name for effect in features.effects for name in effect.inputs if name not in effect.view_inputs
        ]
        self._cloud_arrays = {*SPLAT_ARRAYS, *taken}
        self.real = np.float64 if features.setup_precision == "float64" else np.float32
        self.wide = np.float64 if "blend_double" in features.names else np.float32

    def render(self, resident: Resident, view: View) -> OpenCLPlanes:
        """Draw one picture.

        Raises:
            DeviceError: the device runs out of memory or fails.
        """
        plan = self._plan(resident, view)
        if plan.chunk and self.shape.lists != "ordered":
            # one way of drawing in chunks is enough: where memory is short, sorting takes the least time
            shape = replace(self.shape, lists="ordered")
            return self.backend.pipeline(self.features, shape).render(resident, view)
        backend = self.backend
        way = backend.memory_budget - plan.held
        # what this picture takes anew is planned for; that of its own kind is there already
        backend.pool.make_way((self, view.width, view.height, resident.count, plan), way)
        try:
            run = (ExposedRun if view.shots else Run)(self, resident, view, plan)
            return OpenCLPlanes(run, run.draw())
        except BaseException as error:
            with suppress(cl.Error):
                self.backend.queue.finish()  # a CPU may be reading the arrays of a cloud that nobody keeps
            if isinstance(error, cl.Error):
                raise DeviceError(f"{self.backend.info.title} failed while drawing: {error}") from error
            raise

    def _plan(self, resident: Resident, view: View) -> Plan:
        shape, effects = self.shape, self.features.effects
        tiles_x = -(-view.width // shape.tile_width)
        tiles = tiles_x * -(-view.height // shape.tile_height)
        stays, upload = resident.bytes_for(self._cloud_arrays)
        fixed = stays + SMALL + table_bytes(shape.lists, tiles, shape.chunks, shape.radix_bits)
        fixed += BIG * (4 + self.source.bounds_bytes)
        planes = 4 + sum(planes for effect in effects for planes in effect.planes)
        if view.shots:
            planes *= 2  # the picture's own beside those of a shot
        fixed += 4 * tiles * shape.tile_width * shape.tile_height * planes  # whole tiles
        pixels = view.width * view.height // view.samples**2
        fixed += 4 * pixels * sum(output.channels for output in self.features.outputs)
        arrays = (name for effect in effects for name in (*effect.resolve_arrays, *effect.backdrop_arrays))
        fixed += sum(view.array(name).nbytes for name in arrays)
        if view.raster is not None:
            rasters = {view.raster, *(shot.view.raster for shot in view.shots if shot.view.raster)}
            columns, slopes = tiles_x * shape.tile_width, "rays_box" in self.features.names
            fixed += RayBuffers.bytes_of(rasters, shape.tile_height, columns, slopes)
        backend, record = self.backend, self.source.record_bytes
        budget, largest = backend.memory_budget, backend.device.max_mem_alloc_size
        return plan_of(resident.count, record, upload, fixed, shape.lists, budget, largest)

    def launch(self, queue: cl.CommandQueue, name: str, size: tuple, group: tuple, args: tuple) -> cl.Event:
        """Launch a kernel, setting only those arguments that have changed since its last launch: from picture
        to picture hardly any do, and setting them takes the host longer than a small stage takes a GPU.
        A buffer is remembered by its token, so that a cloud or a picture that nobody has any more is let go.
        """
        kernel = self._kernels[name]
        bound: list[object] = self._bound.pop(name, None) or [None] * len(args)
        for index, argument in enumerate(args):
            if type(argument) is DeviceBuffer:
                mark: object = argument.token
            else:  # part of a buffer is made anew for each launch
                mark = argument if isinstance(argument, np.generic) else object()
            old = bound[index]
            if mark is not old and (type(mark) is not type(old) or mark != old):
                kernel.set_arg(index, argument)
                bound[index] = mark
        self._bound[name] = bound
        return cl.enqueue_nd_range_kernel(queue, kernel, size, group)

    def trace(self, resident: Resident, view: View) -> dict[str, np.ndarray]:
        """Draw one picture and return what passes between the stages.

        keys (n,) uint32; starts (tiles + 1,) uint32; lists (pairs,) uint32, of the last band; records
        (n, words) float32 (undefined for culled splats); raw (4, rows, columns) float32: r, g, b,
        transmittance of the padded sample grid; and the finished outputs by name.
        """
        run = Run(self, resident, view, Plan(0, resident.count, 0))
        planes = OpenCLPlanes(run, run.draw())
        stats = planes.stats
        words = self.source.record_bytes // 4
        return {
            "keys": run.read("keys", np.uint32, (resident.count,)),
            "starts": run.read("starts", np.uint32, (run.tiles + 1,)),
            "lists": run.read("lists", np.uint32, (stats["pairs"],)),
            "records": run.read("splats", np.float32, (resident.count, words)),
            "raw": run.read("raw", np.float32, (4, run.rows, run.stride)),
            **{output.name: planes.read(output.name) for output in self.features.outputs},
        }
