"""Clouds in device buffers."""

from __future__ import annotations

import os
import weakref
from abc import abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.cloud_arrays import kernel_arrays
from fidsplat.backends.interface import DeviceCloud
from fidsplat.backends.opencl.buffers import DeviceBuffer
from fidsplat.backends.opencl.morton_order import MortonOrder
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import color_range

_VECTOR = 16
"""alignment in bytes of the vectors in which kernels read arrays"""


class OpenCLCloud(DeviceCloud):
    """Base class of clouds on an OpenCL device."""

    streamed = False
    """whether every frame copies the cloud to the device, a slice at a time"""
    immutable = True
    """whether the arrays never change, so that a frame can be rendered again later"""
    buffer_key: object = None
    """key of clouds whose frames may share buffers"""
    is_spatially_sorted = False
    """whether splats with neighbouring indices are close to each other, as in stores"""
    sortable = False
    """whether `sorted_array` is available"""

    def __init__(self, count: int) -> None:
        self.count = self.padded_count = count
        """number of splats, and number of splats for which frames allocate buffers"""
        self._buffers: dict[str, cl.Buffer] = {}
        self.cached_frames: dict[tuple[Any, ...], Any] = {}
        """each `RecordedFrame` by its key (`OpenCLPipeline._key`)"""

    @property
    def memory_bytes(self) -> int:
        return sum(buffer.size for buffer in self._buffers.values())

    @abstractmethod
    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        """Bytes of these arrays that stay on the device, and bytes per splat that each frame copies."""

    @abstractmethod
    def array_in_cloud_order(self, name: str, first: int, end: int) -> cl.Buffer:
        """The array of splats [first, end) in the order of the cloud. An UploadedCloud then permanently
        replaces its arrays in Morton order, and releases the cached command lists that read them."""

    def sorted_array(self, name: str) -> cl.Buffer:
        """The array of all splats in Morton order, the same for all arrays."""
        raise NotImplementedError

    def _region(self, complete: cl.Buffer, first: int, end: int, width: int) -> cl.Buffer:
        """Splats [first, end) of a buffer with `width` bytes per splat."""
        if end - first == self.count:
            return complete
        return complete.get_sub_region(first * width, (end - first) * width)


class UploadedCloud(OpenCLCloud):
    """A SplatCloud on the device. A CPU reads the host's arrays. Other devices have copies; labels and
    colours are copied on first use. A cloud of more than half of the memory budget is `streamed`. When
    a frame needs cloud order, arrays in that order replace the sorted arrays for good."""

    def __init__(self, workspace: Workspace, cloud: SplatCloud) -> None:
        super().__init__(len(cloud))
        self.copy_properties(cloud)
        self._workspace, self._arrays = workspace, kernel_arrays(cloud)
        self._order: MortonOrder | None = None
        total = self.count * self._bytes_of(self._arrays)
        widest = max(array.nbytes for array in self._arrays.values())
        device = workspace.device
        # an array exists twice while it is sorted
        self.sortable = total + widest + 4 * self.count <= workspace.memory_budget // 2
        self._shared = workspace.info.kind == "cpu" and bool(device.host_unified_memory)
        if self._shared:
            weakref.finalize(self, _wait_unless_forked, os.getpid(), workspace.queue, workspace.replay_queue)
            return
        self.streamed = total > workspace.memory_budget // 2 or widest > device.max_mem_alloc_size
        if not self.streamed:
            with workspace.device_errors("copying the cloud"):
                self._copy_arrays()
                workspace.queue.finish()

    def _copy_arrays(self) -> None:
        """Copy all arrays that every frame reads."""
        for name in self._arrays.keys() - {"labels", "colors", "sh"}:
            self._buffer(name)

    def _bytes_of(self, names: Iterable[str]) -> int:
        """Bytes per splat of these arrays."""
        return sum([self._array(name).nbytes // max(self.count, 1) for name in names])

    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        if self._shared:
            return 0, 0
        if self.streamed:
            return 0, self._bytes_of(names)
        order = 0 if self._order is None else 5  # bytes per splat: 4 of `splat_ids`, less than 1 of spheres
        return self.count * (order + self._bytes_of({*names, *self._buffers})), 0

    @property
    def memory_bytes(self) -> int:
        """Bytes on the device; 0 if it reads the host's arrays."""
        return 0 if self._shared else super().memory_bytes

    def color_range(self) -> tuple[float, float]:
        return color_range(self._arrays.get("colors"), self._arrays.get("sh"))

    def sorted_array(self, name: str) -> cl.Buffer:
        if self._order is None:
            self._copy_arrays()
            order = MortonOrder(self._workspace, self._array("means"), self._buffer("means"))
            for other, buffer in self._buffers.items():
                self._buffers[other] = order.gather(other, buffer, self._bytes_of([other]))
            order.compute_bounding_spheres(self._buffers)
            self._order = order
        return self._order.arrays.get(name) or self._buffer(name)

    def array_in_cloud_order(self, name: str, first: int, end: int) -> cl.Buffer:
        self.sortable = False
        if self._order is not None:
            self._order = None
            self._buffers.clear()
            self.cached_frames.clear()
        if self.streamed:
            part = np.ascontiguousarray(self._array(name)[first:end])
            buffer = self._workspace.pool.scratch(f"slice of {name}", part.nbytes)
            cl.enqueue_copy(self._workspace.queue, buffer, part)
            return buffer
        return self._region(self._buffer(name), first, end, self._array(name).nbytes // max(self.count, 1))

    def _array(self, name: str) -> np.ndarray:
        """The array on the host; splat ids are created on first use."""
        if name == "splat_ids" and name not in self._arrays:
            self._arrays[name] = np.arange(self.count, dtype=np.int32)
        return self._arrays[name]

    def _buffer(self, name: str) -> cl.Buffer:
        if name not in self._buffers:
            array = _aligned(np.ascontiguousarray(self._array(name)))
            flags = cl.mem_flags
            if array.size == 0:
                buffer = self._workspace.pool.allocate(f"the cloud's {name}", 16)
            elif self._shared:
                flags = flags.READ_ONLY | flags.USE_HOST_PTR
                buffer = DeviceBuffer(self._workspace.context, flags, hostbuf=array)
            else:
                buffer = self._workspace.pool.allocate(f"the cloud's {name}", array.nbytes)
                cl.enqueue_copy(self._workspace.queue, buffer, array)
            if self._order is not None:
                buffer = self._order.gather(name, buffer, self._bytes_of([name]))
            self._buffers[name] = buffer
        return self._buffers[name]


def _wait_unless_forked(process: int, *queues: cl.CommandQueue) -> None:
    """Wait for kernels that may be reading the host's arrays, before these are released; not in a fork."""
    if process == os.getpid():
        for queue in queues:
            with suppress(cl.Error):
                queue.finish()


def _aligned(array: np.ndarray) -> np.ndarray:
    """The array, or a copy of it at an aligned address, as vector loads require."""
    if array.ctypes.data % _VECTOR == 0:
        return array
    memory = np.empty(array.nbytes + _VECTOR, np.uint8)
    first = -memory.ctypes.data % _VECTOR
    copy = memory[first : first + array.nbytes].view(array.dtype).reshape(array.shape)
    copy[...] = array
    return copy
