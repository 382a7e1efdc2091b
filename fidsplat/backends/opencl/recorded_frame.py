"""Frames that are replayed: the command list of one frame, submitted again for the next of its kind.

Frames of a kind run the same kernels with the same arguments, but for their output images and the numbers
of their views. To set these takes the host a fraction of the time of planning a frame, and nothing waits for
the device.
"""

from __future__ import annotations

from collections import deque
from functools import partial
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.counts import read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.view import View

_VIEWS = 256
"""views whose uniforms are cached"""
_VIEWS_BYTES = 1 << 26
"""bytes of their arrays, such as external depth images"""
_UPLOADS = 64
"""copies to the device that may be under way before the host waits for the first"""


class RecordedFrame:
    """The command list of a frame, and what differs from view to view. It holds no splats: their cloud caches
    it (`Resident.cached_frames`)."""

    def __init__(self, frame: DeviceFrame) -> None:
        self.commands, self.capacity = frame.commands, frame.capacity
        self._pool, self._state = frame.pool, frame.pool.state
        self._view, self._arrays = frame.view, frame.arrays
        arguments = {one.name: one for name in self.commands.kernels for one in frame.source.arguments[name]}
        self._of_view = [one for one in arguments.values() if frame.is_of_view(one)]
        """kernel arguments that are numbers of the view"""
        self._views: dict[int, tuple[View, dict[str, np.ndarray], dict[str, Any]]] = {
            id(frame.view): (frame.view, frame.arrays, self._numbers_of(frame))
        }
        """views that were rendered, with their arrays and numbers"""
        self._bytes = 0
        """of those arrays"""
        self._tallies = frame.pool.size("tallies")
        self._uploads: deque[cl.Event] = deque(frame.uploads, maxlen=_UPLOADS)
        self._leases = [(name, buffer.size) for name, buffer in frame.leased]
        self._scratch = [name for name in frame.bound if name not in dict(frame.leased)]

    @property
    def valid(self) -> bool:
        """Whether no scratch buffer was replaced since."""
        return self._pool.state is self._state

    def knows(self, view: View) -> bool:
        """Whether the uniforms of a view are cached."""
        return view is self._view or id(view) in self._views

    def learn(self, frame: DeviceFrame) -> None:
        """Cache the uniforms of another view. frame: of that view, not rendered."""
        frame.put_view(0, frame.rows)
        frame.put_arrays()
        self._uploads.extend(frame.uploads)
        # an array that views share, a panorama say, is counted once
        own = sum(a.nbytes for name, a in frame.arrays.items() if a is not self._arrays.get(name))
        if len(self._views) >= _VIEWS or self._bytes + own > _VIEWS_BYTES:
            self._views.clear()
            self._bytes = 0
        self._bytes += own
        # the view is kept alive, so that no other has its id
        arrays = self._arrays | frame.arrays
        self._views[id(frame.view)] = frame.view, arrays, self._numbers_of(frame)

    def set_view(self, view: View, queue: cl.CommandQueue) -> bool:
        """Bind the uniforms of a view. Returns whether the command list can be submitted: not after a buffer
        was replaced."""
        pool = self._pool
        if view is not self._view:
            _, arrays, numbers = self._views[id(view)]
            self.commands.set(numbers)
            self._view, self._arrays = view, arrays
        for name, array in self._arrays.items():
            _, event = pool.put(queue, name, array)
            if event is not None:  # frames of other kinds use the same buffers
                self._uploads.append(event)
        pool.zeroed("tallies", self._tallies, queue)  # frames of other kinds leave theirs
        return self.valid

    def submit(self, queue: cl.CommandQueue) -> tuple[list[tuple[str, cl.Buffer]], list[cl.Event]]:
        """Render into leased buffers. Returns these by name, and the event of each launch."""
        leased = [(name, self._pool.lease(name, size)) for name, size in self._leases]
        self.commands.set(dict(leased))
        events = self.commands.submit(queue)
        queue.flush()
        return leased, events

    def render(self, frame: DeviceFrame) -> None:
        """Replay as a frame of the view that is bound, with the buffers that its stages leave for
        derivatives."""
        frame.leased, events = self.submit(frame.queue)
        for name in self._scratch:
            if (buffer := self._pool.known(name)) is not None:
                frame.bind(name, buffer)
        for name, buffer in frame.leased:
            frame.bind(name, buffer)
        frame.numbers["big_capacity"], frame.pairs = self.capacity.big, self.capacity.pairs
        frame.events = list(zip(self.commands.stages, events, strict=True))
        frame.counted = events[self.commands.kernels.index("tile_starts")]
        reader, count = frame.workspace.read_queue, frame.resident.count
        frame.stats = partial(read_stats, reader, frame.buffers.counts, events[-1], count)

    def _numbers_of(self, frame: DeviceFrame) -> dict[str, Any]:
        """The numbers of a frame's view, by the names of the kernel arguments."""
        return {argument.name: frame.value(argument) for argument in self._of_view}
