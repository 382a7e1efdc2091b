"""What an open device holds for all pictures: its queues, a pool of scratch buffers, the rays of lenses, and
how much memory a picture may take.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Collection, Hashable, Iterator
from contextlib import contextmanager, suppress
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.backends.interface import DeviceInfo
from fidsplat.backends.opencl.host_memory import HostMemory
from fidsplat.backends.opencl.memory_plan import PAIR
from fidsplat.backends.opencl.pages import large_pages
from fidsplat.backends.opencl.pocl_workarounds import is_pocl
from fidsplat.backends.opencl.pocl_workarounds.shared_programs import shared_context
from fidsplat.backends.opencl.shapes import DeviceShape
from fidsplat.cameras.raster import RayRaster
from fidsplat.util.errors import DeviceError, bytes_words

_LEAST = 16  # bytes; OpenCL has no empty buffers
_LARGE = 1 << 22  # bytes from which large pages are asked for


class DeviceBuffer(cl.Buffer):
    """A buffer with a token of its own: to remember that is not to keep the buffer."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.token = object()


def token_of(buffer: cl.Buffer) -> object:
    """What tells a buffer from every other; a part of one is made again each time."""
    return buffer.token if type(buffer) is DeviceBuffer else object()


class BufferPool:
    """Scratch buffers by name, kept from frame to frame and replaced only when one is too small."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self._device = device
        self._is_host = bool(device.type & cl.device_type.CPU) and bool(device.host_unified_memory)
        """whether its memory is the host's"""
        self._buffers: dict[str, cl.Buffer] = {}
        self._arrays: dict[str, Array] = {}
        self._contents: dict[str, weakref.ref[np.ndarray]] = {}
        self._spare: dict[str, list[cl.Buffer]] = {}
        self._zeroed: set[str] = set()
        self._kind: Hashable = None
        self._splats = 0
        self.state = object()
        """another object whenever a scratch buffer is replaced or let go"""

    def size(self, name: str) -> int:
        """Bytes of the scratch buffer of that name; 0 if there is none yet."""
        return self._buffers[name].size if name in self._buffers else 0

    def known(self, name: str) -> cl.Buffer | None:
        """The scratch buffer of that name, as it is."""
        return self._buffers.get(name)

    def lease(self, name: str, size: int, larger: bool = False) -> cl.Buffer:
        """A buffer for somebody who gives it back (`give_back`) when it is not needed any more. larger:
        whether it may have more bytes."""
        # taken before it is looked at: images that die meanwhile may give back others
        spare = self._spare.get(name, [])
        while spare:
            buffer = spare.pop()
            if buffer.size == max(size, _LEAST) or (larger and buffer.size > size):
                return buffer  # else it was of a picture of another size
        return self.fresh(name, size)

    def give_back(self, buffers: list[tuple[str, cl.Buffer]]) -> None:
        """Keeps one or two leased buffers of a name for the next picture of the same size."""
        for name, buffer in buffers:
            spare = self._spare.setdefault(name, [])
            if not spare or (len(spare) == 1 and spare[0].size == buffer.size):
                spare.append(buffer)

    @property
    def memory_bytes(self) -> int:
        """What the scratch buffers hold, and leased ones that were given back."""
        # copied first: images that die meanwhile give back theirs
        spare = [buffer for buffers in list(self._spare.values()) for buffer in list(buffers)]
        return sum(buffer.size for buffer in (*self._buffers.values(), *spare))

    def make_way(self, kind: Hashable, size: int, splats: int = 0) -> None:
        """Before a picture: lets go of what pictures of another kind have left, if that is more than `size`
        bytes. Pictures of one kind take buffers of the same sizes, or smaller ones for fewer splats."""
        if kind == self._kind and splats <= self._splats:
            return
        if self.memory_bytes > size:
            self.clear()
        self._kind, self._splats = kind, splats

    def forget_zeros(self) -> None:
        """After a failure: nobody knows what is left in buffers of zeros."""
        self._zeroed.clear()
        self.state = object()

    def clear(self) -> None:
        """Lets go of all that it holds."""
        self._spare.clear()
        self._arrays.clear()
        self._buffers.clear()
        self._contents.clear()
        self._zeroed.clear()
        self.state = object()

    def put(self, queue: cl.CommandQueue, name: str, array: np.ndarray) -> tuple[cl.Buffer, cl.Event | None]:
        """A scratch buffer with these contents, and the event of the copy; does not wait. What was put there
        last and nobody can change (a panorama) is not copied again."""
        content = self._contents.get(name)
        if content is not None and content() is array:
            return self._buffers[name], None
        buffer = self.scratch(name, array.nbytes)
        event = cl.enqueue_copy(queue, buffer, array, is_blocking=False)
        if not array.flags.writeable and array.flags.owndata:
            self._contents[name] = weakref.ref(array)
        return buffer, event

    def scratch(self, name: str, size: int) -> cl.Buffer:
        """A buffer of at least `size` bytes whose content is undefined."""
        self._contents.pop(name, None)
        self._zeroed.discard(name)
        held = self._buffers.get(name)
        if held is None or held.size < size:
            self._arrays.pop(name, None)
            self._buffers.pop(name, None)
            self.state = object()
            held = self._buffers[name] = self.fresh(name, size)
        return held

    def array(self, queue: cl.CommandQueue, name: str, shape: tuple[int, ...]) -> Array:
        """A scratch buffer as an array of float32, the same object as long as it can be: to make one takes
        the host longer than to launch a kernel."""
        buffer = self.scratch(name, 4 * math.prod(shape))
        known = self._arrays.get(name)
        if known is None or known.base_data is not buffer or known.shape != shape or known.queue is not queue:
            known = self._arrays[name] = Array(queue, shape, np.float32, data=buffer)
        return known

    def zeroed(self, name: str, size: int, queue: cl.CommandQueue) -> cl.Buffer:
        """A scratch buffer of zeros, for somebody who leaves zeros there."""
        if name not in self._zeroed or self._buffers[name].size < size:
            buffer = self.scratch(name, size)
            cl.enqueue_fill_buffer(queue, buffer, np.zeros(1, np.uint32), 0, buffer.size)
            self._zeroed.add(name)
        return self._buffers[name]

    def fresh(self, name: str, size: int) -> cl.Buffer:
        """A buffer that nobody else holds.

        Raises:
            DeviceError: the device cannot give that much at once.
        """
        limit = self._device.max_mem_alloc_size
        if size > limit:
            raise DeviceError(
                f"{name} needs {bytes_words(size)} in one piece, but {self._device.name.strip()} gives at "
                f"most {bytes_words(limit)}; use fewer splats or a smaller picture"
            )
        try:
            flags = cl.mem_flags.READ_WRITE
            if self._is_host:
                # else PoCL takes memory at the first use, and crashes there if none is left
                flags |= cl.mem_flags.ALLOC_HOST_PTR
            buffer = DeviceBuffer(self._context, flags, max(size, _LEAST))
            if self._is_host and size >= _LARGE:
                # records that lie anywhere are found there without a walk through the tables of pages
                self._ask_for_large_pages(buffer)
            return buffer
        except cl.Error as error:
            raise DeviceError(f"no memory for {name} ({bytes_words(size)}): {error}") from error

    def _ask_for_large_pages(self, buffer: cl.Buffer) -> None:
        """The memory stays the device's, which keeps it until no kernel needs it; this is advice."""
        queue = cl.CommandQueue(self._context)  # of its own: what others hold is not waited for
        memory, _ = cl.enqueue_map_buffer(
            queue, buffer, cl.map_flags.WRITE, 0, (buffer.size,), np.dtype(np.uint8)
        )
        with memory.base:
            large_pages(memory.ctypes.data, memory.nbytes)


class Workspace:
    """An open device: its queues and buffers."""

    def __init__(self, device: cl.Device, info: DeviceInfo, shape: DeviceShape) -> None:
        self.device, self.info, self.shape = device, info, shape
        self.context = shared_context(device) if is_pocl(device) else cl.Context([device])
        self.queue = cl.CommandQueue(self.context, properties=cl.command_queue_properties.PROFILING_ENABLE)
        self.side_queue = cl.CommandQueue(self.context)
        """for what the host reads while the stages run"""
        self.read_queue = cl.CommandQueue(self.context)
        """for what the host reads of pictures that are drawn, beside the next"""
        self.repeat_queue = cl.CommandQueue(self.context)
        """for pictures that were drawn before: without times, a launch takes the host a third less"""
        self._last, self._idle = self.queue, True
        self.pictures = 0
        """that were begun: another one overwrites what the last has left in scratch buffers"""
        self.lock = threading.RLock()
        """held while a picture is put on a queue: scratch buffers and arguments belong to one at a time"""
        self.pool = BufferPool(self.context, device)
        self.host_memory = HostMemory(self.context, device)
        self.ray_buffers = RayBuffers(self)
        self.limit_memory(info.memory_bytes * 9 // 10)

    def turn_to(self, queue: cl.CommandQueue) -> cl.CommandQueue:
        """What is put on this queue from here on comes after all that was put on another."""
        if queue is not self._last:
            if not self._idle:
                before = cl.enqueue_marker(self._last)
                self._last.flush()
                cl.enqueue_barrier(queue, wait_for=[before])
            self._last = queue
        self._idle = False
        return queue

    def finish(self) -> None:
        """Waits for all that was put on queues (with `lock` held)."""
        self._last.finish()
        self._idle = True

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Use the device exclusively. After a failure the device is idle, since a CPU may be reading the
        arrays of a cloud that is released.

        Raises:
            DeviceError: the device fails.
        """
        with self.lock:
            try:
                yield
            except BaseException as error:
                self.pool.forget_zeros()
                for queue in (self.queue, self.repeat_queue):
                    with suppress(cl.Error):
                        queue.finish()
                if isinstance(error, cl.Error):
                    raise DeviceError(f"{self.info.title} failed while rendering: {error}") from error
                raise

    @contextmanager
    def failing(self, what: str) -> Iterator[None]:
        """The device's failures as DeviceError. what: it was doing, as `rendering rgb`."""
        try:
            yield
        except cl.Error as error:
            raise DeviceError(f"{self.info.title} failed while {what}: {error}") from error

    def limit_memory(self, budget: int) -> None:
        """Lets a picture and the cloud take at most `budget` bytes of the device.

        Pictures that need more are drawn in bands of tiles and chunks of splats, with the same bits.
        """
        self.memory_budget = budget
        largest = self.device.max_mem_alloc_size // 8
        self.pair_budget = max(1, min(largest, budget // 8 // PAIR[self.shape.lists], 2**32 - 1))
        """most pairs of splats and tiles that are listed at once"""


class RayBuffers:
    """The buffers `rays`, `ray_map` and so on (kernels/opencl/slot) of the rasters that were drawn last."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace
        self._held: WeakKeyDictionary[RayRaster, dict[tuple[int, int], dict[str, cl.Buffer]]] = (
            WeakKeyDictionary()
        )

    def of(self, raster: RayRaster, rows: int, columns: int, slopes: bool = False) -> dict[str, cl.Buffer]:
        """Buffers by name, for a sample grid that is padded to rows x columns. slopes: those of boxes too."""
        sizes = self._held.setdefault(raster, {})
        if (rows, columns) not in sizes:
            sizes[rows, columns] = {"rays": self._planes("rays", raster.rays, rows, columns)}
            if raster.lens.kind != "equirectangular":
                sizes[rows, columns]["ray_map"] = self._map(raster.whole or raster)
        held = sizes[rows, columns]
        if slopes and "ray_slopes" not in held:
            flat = raster.slopes.reshape(raster.height, raster.width, 6)
            held["ray_slopes"] = self._planes("ray_slopes", flat, rows, columns)
            held["ray_step"] = self._put("ray_step", np.array([raster.step], np.float32))
        return held

    def _planes(self, name: str, array: np.ndarray, rows: int, columns: int) -> cl.Buffer:
        channels = np.full((array.shape[2], rows, columns), np.nan, np.float32)
        channels[:, : array.shape[0], : array.shape[1]] = np.moveaxis(array, 2, 0)
        return self._put(name, channels)

    @staticmethod
    def bytes_of(rasters: Collection[RayRaster], tile_height: int, columns: int, slopes: bool) -> int:
        """What the buffers of the rasters of one picture take, for grids that are padded to whole tiles."""
        rows = sum(-(-raster.height // tile_height) * tile_height for raster in rasters)
        one = next(iter(rasters))
        each = 36 if slopes else 12
        return each * rows * columns + (one.map[0].nbytes if one.lens.kind != "equirectangular" else 0)

    def _map(self, raster: RayRaster) -> cl.Buffer:
        maps = self._held.setdefault(raster, {}).setdefault((0, 0), {})
        if "ray_map" not in maps:
            maps["ray_map"] = self._put("ray_map", raster.map[0])
        return maps["ray_map"]

    def _put(self, name: str, array: np.ndarray) -> cl.Buffer:
        buffer = self._workspace.pool.fresh(name, array.nbytes)
        cl.enqueue_copy(self._workspace.queue, buffer, array)
        return buffer
