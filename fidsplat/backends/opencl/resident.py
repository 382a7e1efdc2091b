"""Clouds in device buffers."""

from __future__ import annotations

import os
import weakref
from collections.abc import Hashable, Iterable
from contextlib import suppress
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.cloud_arrays import kernel_arrays
from fidsplat.backends.interface import ResidentData
from fidsplat.backends.opencl.buffers import DeviceBuffer
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import color_range
from fidsplat.util.errors import DeviceError

_VECTOR = 16
"""alignment in bytes of the vectors in which kernels read arrays"""


class Resident(ResidentData):
    """A SplatCloud on the device.

    A CPU reads the host's arrays without a copy. Other devices have copies; labels and colours are copied
    when a frame first reads them. A cloud that exceeds half of the memory budget is `streamed`: every frame
    copies it to the device, a chunk at a time.
    """

    def __init__(self, workspace: Workspace, cloud: SplatCloud) -> None:
        self._workspace = workspace
        self.count = self.capacity = len(cloud)
        """number of splats, and number for which frames have buffers"""
        self.origin = cloud.origin
        self.sh_degree = cloud.sh_degree
        self.has_coplanar_groups = cloud.coplanar_groups is not None
        self.footprint, self.ellipsoids = cloud.footprint, cloud.ellipsoids
        self._arrays = kernel_arrays(cloud)
        self._buffers: dict[str, cl.Buffer] = {}
        self.cached_frames: dict[Hashable, Any] = {}
        """cached frames for replay, by their kind"""
        self.immutable = True
        """whether the arrays never change, so that a frame can be rendered again later"""
        self.buffer_key: object = None
        """key of clouds that may share buffers"""
        self.coherent = False
        """whether consecutive splats are close to each other, as in stores"""
        total = self.count * self._bytes_of(self._arrays)
        widest = 0
        for array in self._arrays.values():
            widest = max(widest, array.nbytes)
        device = workspace.device
        self._shared = workspace.info.kind == "cpu" and bool(device.host_unified_memory)
        if self._shared:
            weakref.finalize(self, _finish, os.getpid(), workspace.queue, workspace.replay_queue)
        self.streamed = not self._shared and (
            total > workspace.memory_budget // 2 or widest > device.max_mem_alloc_size
        )
        if not self._shared and not self.streamed:
            try:
                for name in self._arrays.keys() - {"labels", "colors", "sh"}:
                    self._whole(name)
                workspace.queue.finish()
            except cl.Error as error:
                raise DeviceError(
                    f"{workspace.info.title} failed while copying the cloud: {error}"
                ) from error

    def _bytes_of(self, names: Iterable[str]) -> int:
        """Bytes per splat of these arrays."""
        size = 0
        for name in names:
            size += self._array(name).nbytes // max(self.count, 1)
        return size

    def bytes_for(self, names: Iterable[str]) -> tuple[int, int]:
        """Memory of these arrays: bytes that stay on the device, and bytes per splat that each frame
        copies."""
        if self._shared:
            return 0, 0
        if self.streamed:
            return 0, self._bytes_of(names)
        return self.count * self._bytes_of({*names, *self._buffers}), 0

    @property
    def memory_bytes(self) -> int:
        """Bytes on the device; 0 where it reads the host's arrays."""
        return 0 if self._shared else sum(buffer.size for buffer in self._buffers.values())

    def color_range(self) -> tuple[float, float]:
        return color_range(self._arrays.get("colors"), self._arrays.get("sh"))

    def part(self, name: str, first: int, end: int) -> cl.Buffer:
        """The array of splats [first, end)."""
        if self.streamed:
            piece = np.ascontiguousarray(self._array(name)[first:end])
            buffer = self._workspace.pool.scratch(f"chunk of {name}", piece.nbytes)
            cl.enqueue_copy(self._workspace.queue, buffer, piece)
            return buffer
        whole = self._whole(name)
        if end - first == self.count:
            return whole
        row = self._array(name).nbytes // self.count
        return whole.get_sub_region(first * row, (end - first) * row)

    def _array(self, name: str) -> np.ndarray:
        """The array on the host; splat ids are made when a frame first reads them."""
        if name == "splat_ids" and name not in self._arrays:
            self._arrays[name] = np.arange(self.count, dtype=np.int32)
        return self._arrays[name]

    def _whole(self, name: str) -> cl.Buffer:
        if name not in self._buffers:
            array = _aligned(np.ascontiguousarray(self._array(name)))
            flags = cl.mem_flags
            if array.size == 0:
                buffer = self._workspace.pool.fresh(f"the cloud's {name}", 16)
            elif self._shared:
                flags = flags.READ_ONLY | flags.USE_HOST_PTR
                buffer = DeviceBuffer(self._workspace.context, flags, hostbuf=array)
            else:
                buffer = self._workspace.pool.fresh(f"the cloud's {name}", array.nbytes)
                cl.enqueue_copy(self._workspace.queue, buffer, array)
            self._buffers[name] = buffer
        return self._buffers[name]


def _finish(process: int, *queues: cl.CommandQueue) -> None:
    """Wait for kernels that may be reading the host's arrays, before these are released. Does nothing in a
    fork."""
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
