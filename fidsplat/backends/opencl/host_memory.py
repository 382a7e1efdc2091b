"""Host memory for images of a GPU: page-locked, so that it is written at the full rate of the bus beside
what is drawn, and used again for the next image of about its size: locking takes longer than writing."""

from __future__ import annotations

import math
import threading
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

_LEAST = 1 << 18  # bytes; smaller images are copied as fast in any memory
_MOST = 1 << 30
"""bytes that are locked at once: of a caller who keeps more pictures, the rest is in other memory"""


@dataclass(frozen=True, eq=False)
class _Locked:
    """Memory that stays mapped as long as it lives."""

    buffer: cl.Buffer
    mapped: np.ndarray


class _Lent:
    """What an array lies in; the memory goes back when no array and no view of one holds this any more."""

    def __init__(self, memory: _Locked, shape: tuple[int, ...], dtype: Any) -> None:
        self._memory = memory
        self.__array_interface__ = {
            "data": (memory.mapped.ctypes.data, False),
            "shape": shape,
            "typestr": np.dtype(dtype).str,
            "version": 3,
        }


class HostMemory:
    """Arrays to which a device copies."""

    def __init__(self, context: cl.Context, device: cl.Device) -> None:
        self._context = context
        self.locks = not device.type & cl.device_type.CPU
        """whether memory is locked: CPUs copy to any in the same time"""
        self._asked: set[int] = set()
        """rooms that were asked for before"""
        self._spare: dict[int, list[_Locked]] = {}
        self._held, self._lock = 0, threading.Lock()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """An array, its contents undefined. The first of about its size is in ordinary memory: one picture
        alone is not worth locking pages."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if not self.locks or size < _LEAST:
            return np.empty(shape, dtype)
        room = _room(size)
        with self._lock:
            memory = self._taken(room)
        if memory is None:
            return np.empty(shape, dtype)
        lent = _Lent(memory, shape, dtype)
        # arrays may die at any point of any thread: what they call takes no lock
        weakref.finalize(lent, self._spare.setdefault(room, []).append, memory).atexit = False
        return np.asarray(lent)

    def _taken(self, room: int) -> _Locked | None:
        if room not in self._asked:
            self._asked.add(room)
            return None
        spare = self._spare.setdefault(room, [])
        if spare:
            return spare.pop()
        if self._held + room > _MOST:
            for other, memories in self._spare.items():
                while memories:
                    memories.pop()
                    self._held -= other
        if self._held + room > _MOST:
            return None
        flags, queue = cl.mem_flags, cl.CommandQueue(self._context)
        access: Any = cl.map_flags.READ | cl.map_flags.WRITE
        try:
            buffer = cl.Buffer(self._context, flags.READ_WRITE | flags.ALLOC_HOST_PTR, room)
            mapped, _ = cl.enqueue_map_buffer(queue, buffer, access, 0, (room,), np.dtype(np.uint8))
        except cl.Error:  # the system locks no more
            self.locks = False
            return None
        self._held += room
        return _Locked(buffer, mapped)


def _room(size: int) -> int:
    """Bytes that are locked for an array: a quarter more at most, so that pictures whose size goes up and
    down, as a viewer's do while one looks around, lie in the same memory."""
    step = 1 << max(size.bit_length() - 3, 0)
    return -(-size // step) * step
