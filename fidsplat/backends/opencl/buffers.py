"""Device buffers: a pool that reuses scratch buffers between frames, and buffers for the rays of lenses."""

from __future__ import annotations

import ctypes
import math
import mmap
import weakref
from collections.abc import Collection, Hashable, Iterable
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from pyopencl.array import Array

from fidsplat.cameras.raster import RayRaster
from fidsplat.util.errors import DeviceError, bytes_words

_MINIMUM = 16  # bytes; OpenCL has no empty buffers
_LARGE = 1 << 22  # bytes from which large pages are requested


class DeviceBuffer(cl.Buffer):
    """A buffer with a token that identifies it without keeping it alive."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.token = object()


def token_of(buffer: cl.Buffer) -> object:
    """The token of a buffer; a new one at each call for a sub-buffer."""
    return buffer.token if type(buffer) is DeviceBuffer else object()


@dataclass(frozen=True, eq=False)
class DeviceRecord:
    """A record in a device buffer, for `BufferPool.upload` in place of a host array."""

    buffer: cl.Buffer
    offset: int
    """bytes"""
    nbytes: int


class BufferPool:
    """Scratch buffers by name, reused from frame to frame and replaced only when one is too small."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self._device = device
        self._is_host_memory = bool(device.type & cl.device_type.CPU) and bool(device.host_unified_memory)
        """whether the device shares the host's memory"""
        self._buffers: dict[str, cl.Buffer] = {}
        self._arrays: dict[str, Array] = {}
        self._contents: dict[str, weakref.ref[np.ndarray | DeviceRecord]] = {}
        self._spare: dict[str, list[cl.Buffer]] = {}
        self._zeroed: set[str] = set()
        self._size_key: Hashable = None
        self._splats = 0
        self.generation = object()
        """a new object whenever a scratch buffer is replaced or released"""

    def size(self, name: str) -> int:
        """Bytes of the scratch buffer of that name; 0 if there is none."""
        return self._buffers[name].size if name in self._buffers else 0

    def get(self, name: str) -> cl.Buffer | None:
        """The scratch buffer of that name; None if there is none."""
        return self._buffers.get(name)

    def acquire(self, name: str, size: int, larger: bool = False) -> cl.Buffer:
        """A buffer that belongs to the caller until `release`. larger: whether it may have more bytes."""
        # remove the buffer before the check: the garbage collector may give back other buffers at any time
        spare = self._spare.get(name, [])
        while spare:
            buffer = spare.pop()
            if buffer.size == max(size, _MINIMUM) or (larger and buffer.size > size):
                return buffer  # any other buffer belonged to frames of another size, and is released
        return self.allocate(name, size)

    def release(self, buffers: Iterable[tuple[str, cl.Buffer]]) -> None:
        """Return acquired buffers; one or two of each name are reused for frames of the same size."""
        for name, buffer in buffers:
            spare = self._spare.setdefault(name, [])
            if not spare or (len(spare) == 1 and spare[0].size == buffer.size):
                spare.append(buffer)

    @property
    def memory_bytes(self) -> int:
        size = 0
        # copied first: the garbage collector may give back buffers at any time
        for buffers in [list(self._buffers.values()), *self._spare.values()]:
            for buffer in buffers.copy():
                size += buffer.size
        return size

    def trim(self, size_key: Hashable, size: int, splats: int = 0) -> None:
        """Release all buffers if they exceed `size` bytes, and the last frames had buffers of other sizes or
        fewer splats than the next frame. size_key: equal for frames with buffers of equal sizes."""
        if size_key == self._size_key and splats <= self._splats:
            return
        if self.memory_bytes > size:
            self.clear()
        self._size_key, self._splats = size_key, splats

    def invalidate_zeros(self) -> None:
        """Mark the contents of zero-filled buffers as unknown, after a failure."""
        self._zeroed.clear()
        self.generation = object()

    def clear(self) -> None:
        self._spare.clear()
        self._arrays.clear()
        self._buffers.clear()
        self._contents.clear()
        self._zeroed.clear()
        self.generation = object()

    def upload(
        self, queue: cl.CommandQueue, name: str, array: np.ndarray | DeviceRecord
    ) -> tuple[cl.Buffer, cl.Event | None]:
        """Copy an array to a scratch buffer without waiting; returns the buffer and the event of the copy. A
        read-only array, or a record, that the buffer already contains is not copied again."""
        content = self._contents.get(name)
        if content is not None and content() is array:
            return self._buffers[name], None
        buffer = self.scratch(name, array.nbytes)
        if isinstance(array, DeviceRecord):
            return buffer, cl.enqueue_copy(
                queue, buffer, array.buffer, byte_count=array.nbytes, src_offset=array.offset
            )
        event = cl.enqueue_copy(queue, buffer, array, is_blocking=False)
        if not array.flags.writeable and array.flags.owndata:
            self._contents[name] = weakref.ref(array)
        return buffer, event

    def set_contents(self, name: str, record: DeviceRecord) -> None:
        """Mark a scratch buffer as a copy of a record, which a kernel has made."""
        self._contents[name] = weakref.ref(record)

    def scratch(self, name: str, size: int) -> cl.Buffer:
        """A buffer of at least `size` bytes with undefined contents."""
        self._contents.pop(name, None)
        self._zeroed.discard(name)
        buffer = self._buffers.get(name)
        if buffer is None or buffer.size < size:
            self._arrays.pop(name, None)
            self._buffers.pop(name, None)
            self.generation = object()
            buffer = self._buffers[name] = self.allocate(name, size)
        return buffer

    def array(self, queue: cl.CommandQueue, name: str, shape: tuple[int, ...]) -> Array:
        """A scratch buffer as a cached float32 array: creating one takes longer than a launch."""
        buffer = self.scratch(name, 4 * math.prod(shape))
        array = self._arrays.get(name)
        if array is None or array.base_data is not buffer or array.shape != shape or array.queue is not queue:
            array = self._arrays[name] = Array(queue, shape, np.float32, data=buffer)
        return array

    def zeroed(self, name: str, size: int, queue: cl.CommandQueue) -> cl.Buffer:
        """A zero-filled scratch buffer; the caller must leave it zeroed."""
        if name not in self._zeroed or self._buffers[name].size < size:
            buffer = self.scratch(name, size)
            cl.enqueue_fill_buffer(queue, buffer, np.zeros(1, np.uint32), 0, buffer.size)
            self._zeroed.add(name)
        return self._buffers[name]

    def allocate(self, name: str, size: int) -> cl.Buffer:
        """A new buffer outside the pool. Raises DeviceError if the device cannot allocate it."""
        limit = self._device.max_mem_alloc_size
        if size > limit:
            raise DeviceError(
                f"{name} must be at most {bytes_words(limit)}, the largest buffer of "
                f"{self._device.name.strip()}, got {bytes_words(size)}; use fewer splats or a smaller frame"
            )
        try:
            flags = cl.mem_flags.READ_WRITE
            if self._is_host_memory:
                # PoCL otherwise allocates the memory at the first use, and crashes if none is left
                flags |= cl.mem_flags.ALLOC_HOST_PTR
            buffer = DeviceBuffer(self._context, flags, max(size, _MINIMUM))
            if self._is_host_memory and size >= _LARGE:
                # without large pages, random accesses to records miss the TLB
                self._request_large_pages(buffer)
            return buffer
        except cl.Error as error:
            raise DeviceError(
                f"no memory for {name} ({bytes_words(size)}): {error}; use fewer splats"
            ) from error

    def _request_large_pages(self, buffer: cl.Buffer) -> None:
        """Advise the system to use large pages for the memory of a buffer."""
        queue = cl.CommandQueue(self._context)  # a separate queue, which does not wait for others
        memory, _ = cl.enqueue_map_buffer(
            queue, buffer, cl.map_flags.WRITE, 0, (buffer.size,), np.dtype(np.uint8)
        )
        with memory.base:
            large_pages(memory.ctypes.data, memory.nbytes)


class RayBuffers:
    """Buffers of the lenses in use: rays of the samples, and the inverse lookup table (LUT) from ray
    directions to samples (part/inverse_lens_lut.cl)."""

    def __init__(self, pool: BufferPool, queue: cl.CommandQueue) -> None:
        self._pool, self._queue = pool, queue
        self._buffers: WeakKeyDictionary[RayRaster, dict[tuple[int, int], dict[str, cl.Buffer]]] = (
            WeakKeyDictionary()
        )

    def of(
        self, raster: RayRaster, rows: int, columns: int, with_derivatives: bool = False
    ) -> dict[str, cl.Buffer]:
        """Buffers by name, for a sample grid padded to rows x columns. with_derivatives: also the
        derivatives of the rays with respect to the sample position, for box splats."""
        sizes = self._buffers.setdefault(raster, {})
        if (rows, columns) not in sizes:
            sizes[rows, columns] = {"rays": self._planar("rays", raster.rays, rows, columns)}
            if raster.lens.kind != "equirectangular":
                tables = self._buffers.setdefault(raster.full_raster or raster, {}).setdefault((0, 0), {})
                if "inverse_lens_lut" not in tables:
                    tables["inverse_lens_lut"] = self._upload("inverse_lens_lut", raster.inverse_lens_lut[0])
                sizes[rows, columns]["inverse_lens_lut"] = tables["inverse_lens_lut"]
        buffers = sizes[rows, columns]
        if with_derivatives and "ray_derivatives" not in buffers:
            flat = raster.ray_derivatives.reshape(raster.height, raster.width, 6)
            buffers["ray_derivatives"] = self._planar("ray_derivatives", flat, rows, columns)
            buffers["max_ray_derivative"] = self._upload(
                "max_ray_derivative", np.array([raster.max_ray_derivative], np.float32)
            )
        return buffers

    def _planar(self, name: str, array: np.ndarray, rows: int, columns: int) -> cl.Buffer:
        """An image (rows, columns, channels) as a buffer (channels, rows, columns), padded with NaN."""
        channels = np.full((array.shape[2], rows, columns), np.nan, np.float32)
        channels[:, : array.shape[0], : array.shape[1]] = np.moveaxis(array, 2, 0)
        return self._upload(name, channels)

    @staticmethod
    def bytes_of(
        rasters: Collection[RayRaster], tile_height: int, columns: int, with_derivatives: bool
    ) -> int:
        """Bytes of the ray buffers of a frame, for sample grids padded to complete tiles."""
        rows = sum(-(-raster.height // tile_height) * tile_height for raster in rasters)
        first = next(iter(rasters))
        ray_bytes = 36 if with_derivatives else 12
        return ray_bytes * rows * columns + (
            first.inverse_lens_lut[0].nbytes if first.lens.kind != "equirectangular" else 0
        )

    def _upload(self, name: str, array: np.ndarray) -> cl.Buffer:
        buffer = self._pool.allocate(name, array.nbytes)
        cl.enqueue_copy(self._queue, buffer, array)
        return buffer


def large_pages(address: int, size: int) -> bool:
    """Advise the system to use large pages for [address, address + size); returns whether it did."""
    advice = getattr(mmap, "MADV_HUGEPAGE", None)  # only on Linux
    first = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
    end = (address + size) // mmap.PAGESIZE * mmap.PAGESIZE
    if advice is None or end <= first:
        return False
    return ctypes.CDLL(None).madvise(ctypes.c_void_p(first), ctypes.c_size_t(end - first), advice) == 0
