"""Launches of a picture, kept to be launched again for the next of its kind.

A picture of a kind that was drawn before needs the same kernels with the same arguments, but for the images
that it gives away and the numbers of its view: only those are set again. That takes the host a fraction of
what it takes to plan the picture, and nothing waits for the device.
"""

from __future__ import annotations

from collections import deque
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.declare import Argument
from fidsplat.backends.opencl.lists import TiledLists
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.opencl.program import put_argument
from fidsplat.backends.opencl.workspace import token_of
from fidsplat.backends.view import View

Launched: TypeAlias = tuple[list[tuple[str, cl.Buffer]], cl.Event, list[tuple[str, cl.Event]]]
_VIEWS = 256
"""that are kept ready"""
_VIEWS_BYTES = 1 << 26
"""that their arrays may take together: layers, say"""
_UPLOADS = 64
"""copies to the device that may be under way before the host waits for the first"""


class Recording:
    """What one picture launched. It holds no splats: it lives as long as their cloud (`Resident.kept`)."""

    def __init__(self, picture: Picture) -> None:
        self._pool, self._state = picture.pool, picture.pool.state
        self.capacity, self.big = TiledLists.capacity(picture.workspace), picture.held["big_capacity"]
        """pairs and big splats for which there is room"""
        self._view, self._arrays = picture.view, picture.arrays
        self._ready: dict[int, tuple[View, dict[str, np.ndarray], list[Any]]] = {}
        """of views that were drawn: arrays, and values of the numbers"""
        self._bytes = 0
        """of those arrays"""
        self._tallies = picture.pool.size("tallies")
        self._uploads: deque[cl.Event] = deque(picture.uploads, maxlen=_UPLOADS)
        self._leases = [(name, buffer.size) for name, buffer in picture.leased]
        self._takers: dict[str, list[tuple[cl.Kernel, int]]] = {name: [] for name, _ in self._leases}
        self._bound: dict[str, object] = {}
        self._numbers: list[tuple[cl.Kernel, int, Argument, Any]] = []
        """arguments that are numbers of the view, with their types"""
        self._values: list[Any] = []
        """what they are now"""
        self._launches: list[tuple[str, cl.Kernel, tuple[int, ...], tuple[int, ...]]] = []
        """with their stages"""
        leased = {id(buffer): name for name, buffer in picture.leased}
        program = picture.program
        for stage, name, size, group, values in picture.launched:
            kernel = program.bound(name, values)
            self._launches.append((stage, kernel, size, group))
            for index, (argument, value) in enumerate(
                zip(program.source.arguments[name], values, strict=True)
            ):
                if id(value) in leased:
                    self._takers[leased[id(value)]].append((kernel, index))
                elif picture.is_of_view(argument):
                    self._numbers.append((kernel, index, argument, program.type_of(name, index)))
                    self._values.append(value)
        self._ready[id(self._view)] = self._view, self._arrays, self._values

    def fits(self, view: View, picture_of: Any, queue: cl.CommandQueue) -> bool:
        """Makes it ready for a view. Returns whether it still can be launched: not where buffers were
        replaced.

        picture_of: makes a picture of a view, not drawn.
        """
        pool = self._pool
        if pool.state is not self._state:
            return False
        if view is not self._view:
            if id(view) not in self._ready:
                self._prepare(picture_of(view))
            _, arrays, values = self._ready[id(view)]
            before = zip(self._numbers, self._values, values, strict=True)
            for (kernel, index, _, scalar), old, value in before:
                if value != old:
                    put_argument(kernel, index, value, scalar)
            self._view, self._arrays, self._values = view, arrays, values
        for name, array in self._arrays.items():
            _, event = pool.put(queue, name, array)
            if event is not None:  # pictures of other kinds have theirs in the same buffers
                self._uploads.append(event)
        pool.zeroed("tallies", self._tallies, queue)  # where a picture of another kind has left its own
        return pool.state is self._state

    def _prepare(self, picture: Picture) -> None:
        """What a view that was not drawn yet needs, all of it the host's."""
        picture.put_view(0, picture.rows)
        picture.put_arrays()
        self._uploads.extend(picture.uploads)
        # what views have in common, a panorama say, counts once
        own = sum(a.nbytes for name, a in picture.arrays.items() if a is not self._arrays.get(name))
        if len(self._ready) >= _VIEWS or self._bytes + own > _VIEWS_BYTES:
            self._ready.clear()
            self._bytes = 0
        self._bytes += own
        values = [picture.value(argument) for _, _, argument, _ in self._numbers]
        # the view is held, so that no other is found by its number
        self._ready[id(picture.view)] = picture.view, self._arrays | picture.arrays, values

    def launch(self, queue: cl.CommandQueue, timed: bool = False) -> Launched:
        """Draws the picture into leased buffers. Returns them by name, the last event, and the events
        of all launches with their stages if it is timed."""
        pool, bound = self._pool, self._bound
        leased = [(name, pool.lease(name, size)) for name, size in self._leases]
        for name, buffer in leased:
            # a token: what is remembered does not keep the buffer
            token = token_of(buffer)
            if bound.get(name) is not token:
                for kernel, index in self._takers[name]:
                    kernel.set_arg(index, buffer)
                bound[name] = token
        last, events = None, []
        for stage, kernel, size, group in self._launches:
            last = cl.enqueue_nd_range_kernel(queue, kernel, size, group)
            if timed:
                events.append((stage, last))
        queue.flush()
        assert last is not None  # a picture has launches
        return leased, last, events
