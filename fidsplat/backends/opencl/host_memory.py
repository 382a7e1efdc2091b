"""Pinned (page-locked) host memory for images of a GPU: copies to it use the full bandwidth of the bus and
overlap with rendering.

Pinning takes longer than copying, so memory is reused for images of about the same size.
"""

from __future__ import annotations

import math
import threading
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

_MINIMUM = 1 << 18
"""minimum bytes of pinned memory: smaller images are copied to ordinary memory at the same speed"""
_MAXIMUM = 1 << 30
"""maximum bytes that are pinned at once; further images use ordinary memory"""


@dataclass(frozen=True, eq=False)
class _PinnedBuffer:
    """A buffer that stays mapped during its lifetime."""

    buffer: cl.Buffer
    mapped: np.ndarray


class _ArrayMemory:
    """The base object of an array in pinned memory, which is reused once the array is released."""

    def __init__(self, memory: _PinnedBuffer, shape: tuple[int, ...], dtype: Any) -> None:
        self._memory = memory
        self.__array_interface__ = {
            "data": (memory.mapped.ctypes.data, False),
            "shape": shape,
            "typestr": np.dtype(dtype).str,
            "version": 3,
        }


class HostMemory:
    """Allocator of host arrays as targets of copies from a device."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self.pins_memory = not device.type & cl.device_type.CPU
        """whether arrays are in pinned memory; on a CPU, pinned memory saves no time"""
        self._requested: set[int] = set()
        """capacities that were requested before"""
        self._spare: dict[int, list[_PinnedBuffer]] = {}
        """unused buffers by their capacity"""
        self._pinned, self._lock = 0, threading.Lock()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """An array with undefined contents; pinned memory from the second request of its size on."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self.pins_memory or size < _MINIMUM:
            return np.empty(shape, dtype)
        capacity = rounded_up(size, 3)
        with self._lock:
            memory = self._acquire(capacity)
        if memory is None:
            return np.empty(shape, dtype)
        base = _ArrayMemory(memory, shape, dtype)
        # the finalizer takes no lock, as the garbage collector may run it at any time in any thread
        weakref.finalize(base, self._spare.setdefault(capacity, []).append, memory).atexit = False
        return np.asarray(base)

    def _acquire(self, capacity: int) -> _PinnedBuffer | None:
        """An unused or new pinned buffer; None for ordinary memory."""
        if capacity not in self._requested:
            self._requested.add(capacity)
            return None
        spare = self._spare.setdefault(capacity, [])
        if spare:
            return spare.pop()
        if self._pinned + capacity > _MAXIMUM:
            for other, buffers in self._spare.items():
                while buffers:
                    buffers.pop()
                    self._pinned -= other
        if self._pinned + capacity > _MAXIMUM:
            return None
        flags, queue = cl.mem_flags, cl.CommandQueue(self._context)
        access: Any = cl.map_flags.READ | cl.map_flags.WRITE
        try:
            buffer = cl.Buffer(self._context, flags.READ_WRITE | flags.ALLOC_HOST_PTR, capacity)
            mapped, _ = cl.enqueue_map_buffer(queue, buffer, access, 0, (capacity,), np.dtype(np.uint8))
        except cl.Error:  # the system refuses to pin more memory
            self.pins_memory = False
            return None
        self._pinned += capacity
        return _PinnedBuffer(buffer, mapped)


def rounded_up(count: int, bits: int) -> int:
    """`count` rounded up to a number with `bits` significant binary digits, so that frames of similar sizes
    reuse buffers."""
    step = 1 << max(count.bit_length() - bits, 0)
    return -(-count // step) * step
