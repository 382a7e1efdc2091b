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

from fidsplat.backends.opencl.lists import TiledLists
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.view import View

Launched: TypeAlias = tuple[list[tuple[str, cl.Buffer]], list[cl.Event]]
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
        self._ready: dict[int, tuple[View, dict[str, np.ndarray], dict[str, Any]]] = {}
        """of views that were drawn: arrays, and values of the numbers"""
        self._bytes = 0
        """of those arrays"""
        self._tallies = picture.pool.size("tallies")
        self._uploads: deque[cl.Event] = deque(picture.uploads, maxlen=_UPLOADS)
        self._leases = [(name, buffer.size) for name, buffer in picture.leased]
        self.commands = picture.commands
        arguments = {
            one.name: one for name in self.commands.kernels for one in picture.source.arguments[name]
        }
        self._numbers = [one for one in arguments.values() if picture.is_of_view(one)]
        """arguments that are numbers of the view"""
        self._ready[id(self._view)] = self._view, self._arrays, self._values_of(picture)

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
            self.commands.set(values)
            self._view, self._arrays = view, arrays
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
        # the view is held, so that no other is found by its number
        arrays = self._arrays | picture.arrays
        self._ready[id(picture.view)] = picture.view, arrays, self._values_of(picture)

    def _values_of(self, picture: Picture) -> dict[str, Any]:
        """The numbers of a picture's view, by the names of the arguments."""
        return {argument.name: picture.value(argument) for argument in self._numbers}

    def launch(self, queue: cl.CommandQueue) -> Launched:
        """Draws the picture into leased buffers. Returns them by name, and the events of all launches."""
        leased = [(name, self._pool.lease(name, size)) for name, size in self._leases]
        commands = self.commands
        commands.set(dict(leased))
        events = commands.submit(queue)
        queue.flush()
        return leased, events
