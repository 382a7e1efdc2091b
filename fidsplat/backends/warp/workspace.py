"""State of an open Warp device: scratch arrays, cached arrays of lenses and panoramas, memory budget."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import numpy as np

from fidsplat.backends.warp.runtime import load
from fidsplat.cameras.raster import RayRaster
from fidsplat.capture.environment import Panorama
from fidsplat.util.errors import DeviceError, bytes_words


class ArrayPool:
    """Scratch arrays by name, reused from frame to frame and replaced only when one is too small."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self._arrays: dict[tuple[str, Any], Any] = {}
        self._parts: dict[tuple[str, Any], Any] = {}
        self._memory: dict[tuple[str, Any], tuple[Any, np.ndarray]] = {}
        """cached views of scratch arrays on the CPU, with their memory as NumPy arrays"""
        self._hosts: dict[str, Any] = {}
        self._spare: dict[str, list[Any]] = {}
        self.generation = object()
        """a new object whenever a scratch array is replaced"""
        self.holders: WeakSet[Any] = WeakSet()
        """caches that reference scratch arrays; their `release_arrays` is called when an array is replaced"""

    def scratch(self, name: str, size: int, dtype: Any) -> Any:
        """An array of at least `size` elements with undefined contents."""
        array = self._arrays.get((name, dtype))
        if array is None or array.size < size:
            if array is not None:
                del self._arrays[name, dtype], array
                self._parts.pop((name, dtype), None)
                self._memory.pop((name, dtype), None)
                self.generation = object()
                for holder in list(self.holders):
                    holder.release_arrays()
            array = self._arrays[name, dtype] = self.allocate(name, size, dtype)
        return array

    def exact(self, name: str, size: int, dtype: Any) -> Any:
        whole = self.scratch(name, size, dtype)
        part = self._parts.get((name, dtype))
        if part is None or part.ptr != whole.ptr or part.size != size:
            part = self._parts[name, dtype] = whole[:size]
        return part

    def filled(self, name: str, values: Any, dtype: Any) -> Any:
        """Copy a host array, or an array of this device, to a scratch array of the same size."""
        wp = load()
        on_device = isinstance(values, wp.array)
        if self.device.is_cuda or on_device:
            given = values.flatten() if on_device else wp.array(values, dtype=dtype, device="cpu")
            array = self.exact(name, given.size, dtype)
            wp.copy(array, given)
            return array
        per_element = 1 if values.dtype.names else wp.types.type_size(dtype)
        array = self.exact(name, values.size // per_element, dtype)
        cached = self._memory.get((name, dtype))
        if cached is None or cached[0] is not array:  # making the NumPy array takes longer than filling it
            cached = self._memory[name, dtype] = array, array.numpy()
        cached[1][...] = values.reshape(cached[1].shape)
        return array

    def host(self, name: str, size: int, dtype: Any) -> Any:
        """A page-locked array in host memory."""
        if name not in self._hosts:
            self._hosts[name] = load().empty(size, dtype=dtype, device="cpu", pinned=self.device.is_cuda)
        return self._hosts[name]

    def acquire(self, name: str, size: int, dtype: Any) -> tuple[Any, np.ndarray]:
        """A page-locked host array until `release`, and its memory as a NumPy array."""
        if spare := self._spare.setdefault(name, []):
            return spare.pop()
        array = load().empty(size, dtype=dtype, device="cpu", pinned=self.device.is_cuda)
        return array, array.numpy()

    def release(self, name: str, acquired: tuple[Any, np.ndarray]) -> None:
        """Return an array of `acquire` to the pool."""
        self._spare[name].append(acquired)

    def allocate(self, name: str, size: int, dtype: Any) -> Any:
        """A new array outside the pool. Raises DeviceError if the device has too little memory."""
        wp = load()
        try:
            return wp.empty(max(size, 1), dtype=dtype, device=self.device)
        except (RuntimeError, MemoryError, ValueError) as error:  # ValueError: 2^31 elements and more
            size *= wp.types.type_size_in_bytes(dtype)
            raise DeviceError(
                f"{name} must fit the memory of {self.device}, got {bytes_words(size)}; use fewer splats or "
                "a smaller image"
            ) from error


class Workspace:
    def __init__(self, device: Any, name: str, memory_budget: int) -> None:
        """name: name of the device, for errors."""
        self.device, self.name, self._lock = device, name, threading.RLock()
        self.pool = ArrayPool(device)
        self.memory_budget = memory_budget
        """maximum device memory in bytes of a frame and its cloud"""
        self.pair_budget = 2**30 - 1
        """maximum number of (splat, tile) pairs in the lists at once; tests lower it"""
        self.asynchronous = device.is_cuda
        """whether frames with a cached capacity are submitted without waiting for their counts"""
        self.replays = device.is_cuda
        """whether such frames are recorded as command lists and replayed"""
        self.frames = 0
        """number of frames started; each overwrites the scratch arrays of the previous one"""
        self.lenses: WeakKeyDictionary[RayRaster, dict[str, Any]] = WeakKeyDictionary()
        """device arrays of the rays of lenses, by name"""
        self.panoramas: WeakKeyDictionary[Panorama, Any] = WeakKeyDictionary()
        """device arrays of panoramas, as long as their host arrays exist"""

    @cached_property
    def first_index(self) -> Any:
        """The batch index of a single view, as an array with one 0."""
        return load().zeros(1, dtype=load().int32, device=self.device)

    @cached_property
    def capture_stream(self) -> Any:
        return load().Stream(self.device) if self.device.is_cuda else None

    @contextmanager
    def working(self, doing: str) -> Iterator[None]:
        """A context with exclusive use of the device, also for reading images, as that may render again."""
        with self._lock, self.device_errors(doing), load().ScopedDevice(self.device):
            yield

    @contextmanager
    def device_errors(self, doing: str) -> Iterator[None]:
        """A context that raises the device's failures as DeviceError. doing: the activity."""
        try:
            yield
        except RuntimeError as error:
            if isinstance(error, DeviceError):
                raise
            raise DeviceError(f"{self.name} failed {doing}: {error}") from error


def nbytes(array: Any) -> int:
    """Bytes of a wp.array."""
    return array.size * load().types.type_size_in_bytes(array.dtype)
