"""What a device's pictures share: scratch arrays, arrays of lenses and panoramas, and the memory they may
take."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

from fidsplat.backends.warp.runtime import load
from fidsplat.cameras.raster import RayRaster
from fidsplat.capture.environment import Panorama
from fidsplat.util.errors import DeviceError, bytes_words


class ArrayPool:
    """Scratch arrays by name, kept from frame to frame and replaced only when one is too small."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self._arrays: dict[tuple[str, Any], Any] = {}
        self._parts: dict[tuple[str, Any], Any] = {}
        self._hosts: dict[str, Any] = {}
        self._spare: dict[str, list[Any]] = {}
        self.state = object()
        """another one whenever a scratch array has been replaced"""
        self.holders: WeakSet[Any] = WeakSet()
        """what holds scratch arrays from picture to picture: told to `forget` them when one is replaced"""

    def scratch(self, name: str, size: int, dtype: Any) -> Any:
        """An array of at least `size` elements whose content is undefined."""
        held = self._arrays.get((name, dtype))
        if held is None or held.size < size:
            if held is not None:
                del self._arrays[name, dtype], held
                self._parts.pop((name, dtype), None)
                self.state = object()
                for holder in list(self.holders):
                    holder.forget()
            held = self._arrays[name, dtype] = self.fresh(name, size, dtype)
        return held

    def exact(self, name: str, size: int, dtype: Any) -> Any:
        """The first `size` elements of a scratch array."""
        whole = self.scratch(name, size, dtype)
        part = self._parts.get((name, dtype))
        if part is None or part.ptr != whole.ptr or part.size != size:
            part = self._parts[name, dtype] = whole[:size]
        return part

    def filled(self, name: str, values: Any, dtype: Any) -> Any:
        """A scratch array that holds these values of the host, as long as they are."""
        wp = load()
        given = wp.array(values, dtype=dtype, device="cpu")
        held = self.exact(name, given.size, dtype)
        wp.copy(held, given)
        return held

    def host(self, name: str, size: int, dtype: Any) -> Any:
        """An array of the host that the device can write to without a detour."""
        if name not in self._hosts:
            self._hosts[name] = load().empty(size, dtype=dtype, device="cpu", pinned=self.device.is_cuda)
        return self._hosts[name]

    def lend(self, name: str, size: int, dtype: Any) -> Any:
        """As `host`, of which there are several at a time; `give_back` takes it again."""
        spare = self._spare.setdefault(name, [])
        return (
            spare.pop()
            if spare
            else load().empty(size, dtype=dtype, device="cpu", pinned=self.device.is_cuda)
        )

    def give_back(self, name: str, array: Any) -> None:
        """What `lend` gave, which nobody reads or writes any more."""
        self._spare[name].append(array)

    def fresh(self, name: str, size: int, dtype: Any) -> Any:
        """An array that nobody else holds.

        Raises:
            DeviceError: the device cannot give that much.
        """
        wp = load()
        try:
            return wp.empty(max(size, 1), dtype=dtype, device=self.device)
        except (RuntimeError, MemoryError, ValueError) as error:  # the last: 2^31 elements and more
            raise DeviceError(
                f"{name} needs {bytes_words(size * wp.types.type_size_in_bytes(dtype))}, which "
                f"{self.device} has not; use fewer splats or a smaller picture"
            ) from error


class Workspace:
    """Of one open device."""

    def __init__(self, device: Any, name: str, memory_budget: int) -> None:
        """name: of the device, for errors."""
        self.device, self.name, self._lock = device, name, threading.RLock()
        self.pool = ArrayPool(device)
        self.memory_budget = memory_budget
        """bytes of the device that a picture and its cloud may take"""
        self.pair_budget = 2**30 - 1
        """Most pairs of splats and tiles that are listed at once; tests make it small."""
        self.ahead = device.is_cuda
        """Whether pictures of a kind that was drawn before are drawn without waiting for what they take."""
        self.replays = device.is_cuda
        """Whether the launches of such pictures are captured as a graph, and the graph launched."""
        self.pictures = 0
        """how many have been begun: what they leave is there until the next"""
        self.lenses: WeakKeyDictionary[RayRaster, dict[str, Any]] = WeakKeyDictionary()
        """arrays of the whole rasters that are in use, by name"""
        self.panoramas: WeakKeyDictionary[Panorama, Any] = WeakKeyDictionary()
        """on the device, each as long as it is somewhere else"""

    @cached_property
    def first_slot(self) -> Any:
        """Where the images of a view stand that is no part of a batch: an array of a 0."""
        return load().zeros(1, dtype=load().int32, device=self.device)

    @cached_property
    def _side(self) -> Any:
        return load().Stream(self.device)

    def capturing(self) -> Any:
        """The stream on which launches are captured; None where there are no streams."""
        return self._side if self.device.is_cuda else None

    @contextmanager
    def working(self, doing: str) -> Iterator[None]:
        """On the device, which is one thread's at a time: pictures that were drawn ahead may have to be drawn
        again by who reads them.

        Raises:
            DeviceError: as `failing`.
        """
        with self._lock, self.failing(doing), load().ScopedDevice(self.device):
            yield

    @contextmanager
    def failing(self, doing: str) -> Iterator[None]:
        """Failures of the device are those of what is done there.

        Raises:
            DeviceError: the device fails.
        """
        try:
            yield
        except RuntimeError as error:
            if isinstance(error, DeviceError):
                raise
            raise DeviceError(f"{self.name} failed {doing}: {error}") from error


def nbytes(array: Any) -> int:
    """Bytes of a wp.array."""
    return array.size * load().types.type_size_in_bytes(array.dtype)
