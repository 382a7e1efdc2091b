"""Frame replay: the command list of a frame is submitted again for another view of the same cloud. Only
output images and arguments of the view are set, which is much faster than planning a frame. On a CPU the host
reads the counts before the lists are written, as in `render_sort_first`.
"""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import pyopencl as cl

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.opencl.buffers import DeviceRecord
from fidsplat.backends.opencl.counts import COUNTERS, Capacity, Counts, enlarged, read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame, Rendered
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.uniforms import projection_arrays, scalar_arguments
from fidsplat.backends.view import View

_VIEWS = 256
"""maximum number of views whose uniforms are cached"""
_VIEWS_BYTES = 1 << 26
"""maximum bytes of cached arrays of views, such as external depth images"""
_UPLOADS = 64
"""maximum number of pending copies to the device"""
_ZERO = np.zeros(1, np.uint32)
_CachedView: TypeAlias = tuple[View, dict[str, np.ndarray | DeviceRecord], dict[str, Any]]
"""a view with its arrays and scalar arguments"""


class RecordedFrame:
    """The command list of a frame, and the arguments that differ between views. It must not reference the
    cloud, which caches it."""

    def __init__(self, frame: DeviceFrame) -> None:
        self.workspace, self.commands, self.capacity = frame.workspace, frame.commands, frame.capacity
        self.generation = frame.pool.generation
        """`BufferPool.generation` of the bound scratch buffers"""
        self._waits = frame.waits
        """whether the host waits for the counts of each frame"""
        self._rows, self._counter_bytes = frame.rows, frame.pool.size("counters")
        if frame.waits:
            pairs = min(frame.pool.size("lists") // 4, frame.workspace.pair_budget)
            self.capacity, self._counter_bytes = Capacity(self.capacity.big, pairs), 4 * COUNTERS
        self.launches_until_counts = frame.launches_until_counts
        self._stages = self.commands.stages
        self._source = frame.source
        self._view, self._arrays = frame.view, frame.arrays
        self._views: dict[int, _CachedView] = {
            id(frame.view): (frame.view, frame.arrays, scalar_arguments(frame.view, frame.source))
        }
        """rendered views with their arrays and scalar arguments"""
        self._bytes = 0
        self._uploads: deque[cl.Event] = deque(frame.uploads, maxlen=_UPLOADS)
        self._acquired_sizes = [(name, buffer.size) for name, buffer in frame.acquired.items()]
        self._scratch_names = [name for name in frame.named if name not in frame.acquired]

    def set_view(self, view: View, queue: cl.CommandQueue) -> bool:
        """Bind the uniforms of a view. Returns False if a scratch buffer was replaced."""
        pool = self.workspace.pool
        if pool.generation is not self.generation:
            return False
        if view is not self._view:
            _, arrays, scalars = self._views.get(id(view)) or self._cache_view(view)
            self.commands.set(scalars)
            self._view, self._arrays = view, arrays
        for name, array in self._arrays.items():
            _, event = pool.upload(queue, name, array)
            if event is not None:  # other frames have overwritten the buffer
                self._uploads.append(event)
        if not self._waits:
            pool.zeroed("counters", self._counter_bytes, queue)  # other frames do not clear it
        return pool.generation is self.generation

    def submit(self, queue: cl.CommandQueue, splats: int) -> Rendered | None:
        """Render the bound view. None if the host waits for the counts and they exceed the capacity."""
        commands, pool = self.commands, self.workspace.pool
        acquired = {name: pool.acquire(name, size) for name, size in self._acquired_sizes}
        commands.set(acquired)
        if not self._waits:
            events = commands.submit(queue)
            queue.flush()
            stats = partial(read_stats, self.workspace.read_queue, acquired["counts"], events[-1], splats)
            stages = None if queue is self.workspace.replay_queue else self._stages
            return Rendered(queue, acquired, stats, events, stages)
        counters = pool.scratch("counters", self._counter_bytes)
        cl.enqueue_fill_buffer(queue, counters, _ZERO, 0, self._counter_bytes)
        events = commands.submit(queue, 0, self.launches_until_counts)
        words = np.empty((1, COUNTERS), np.uint32)
        cl.enqueue_copy(queue, words, counters)
        counts = Counts.of_counters(words)
        if not (self.capacity.holds(counts) or self._enlarge_lists(counts)):
            pool.release(acquired.items())
            return None
        events += commands.submit(queue, self.launches_until_counts)
        queue.flush()
        return Rendered(queue, acquired, partial(counts.stats, splats), events, self._stages)

    def _enlarge_lists(self, counts: Counts) -> bool:
        """Bind larger lists if needed, where the host waits for the counts; returns whether they suffice."""
        if counts.big > self.capacity.big or counts.pairs > self.workspace.pair_budget:
            return False
        pairs = enlarged(counts.pairs, self.workspace.pair_budget)
        self.commands.set({"lists": self.workspace.pool.scratch("lists", 4 * pairs)})
        self.capacity, self.generation = Capacity(self.capacity.big, pairs), self.workspace.pool.generation
        return True

    def render(self, frame: DeviceFrame) -> None:
        """Replay the bound view, and bind its buffers to `frame` for the backward pass."""
        rendered = self.submit(frame.queue, frame.resident.count)
        assert rendered is not None  # on CPUs frames with derivatives are not replayed
        frame.acquired, events = rendered.acquired, rendered.events
        for name in self._scratch_names:
            if (buffer := frame.pool.get(name)) is not None:
                frame.bind(name, buffer)
        frame.named |= frame.acquired
        frame.scalars["big_capacity"], frame.pairs = self.capacity.big, self.capacity.pairs
        frame.events, frame.stages = events, self._stages.copy()
        frame.counted, frame.stats = events[self.launches_until_counts - 1], rendered.stats

    def _cache_view(self, view: View) -> _CachedView:
        arrays = projection_arrays(ViewBatch.single(view), self._source, 0, self._rows)
        for name in self._source.view_arrays:
            arrays[name] = view.array(name)
        # count arrays that views share, such as a panorama, once
        size = sum(array.nbytes for name, array in arrays.items() if array is not self._arrays.get(name))
        if len(self._views) >= _VIEWS or self._bytes + size > _VIEWS_BYTES:
            self._views.clear()
            self._bytes = 0
        self._bytes += size
        # a reference to the view, so that no other view has its id
        cached = view, self._arrays | arrays, scalar_arguments(view, self._source)
        self._views[id(view)] = cached
        return cached


class Replay:
    """A frame replayed on a GPU; its counts are compared with the capacity when it is first read."""

    def __init__(
        self,
        recorded: RecordedFrame,
        resident: Resident,
        view: View,
        render_again: Callable[[Resident, View], Rendered],
    ) -> None:
        """render_again: function that renders the view with sufficient buffers."""
        self._recorded, self._view, self._render_again = recorded, view, render_again
        self._frame_number = recorded.workspace.frames
        self._resident: Resident | None = resident
        self._weak_resident = weakref.ref(resident)

    def render_on_overflow(self, rendered: Rendered) -> Rendered | None:
        """Render the frame again if its counts exceed the capacity; None if it is complete."""
        resident, workspace = self._resident, self._recorded.workspace
        if resident is None:
            return None
        queue, after = rendered.queue, None  # faster than waiting from another queue
        if workspace.frames != self._frame_number:  # later frames were submitted: do not wait for them
            queue.flush()
            queue, after = workspace.read_queue, rendered.events[-1:]
        counts = Counts.read(queue, rendered.acquired["counts"], after)
        complete = None if self._recorded.capacity.holds(counts) else self._render_again(resident, self._view)
        self._resident = None  # release the cloud, which is no longer needed
        return complete

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage, from another replay with profiling; empty if the cloud was released."""
        resident, recorded, workspace = self._weak_resident(), self._recorded, self._recorded.workspace
        if resident is None:
            return {}
        with workspace.rendering():
            queue = workspace.switch_to(workspace.queue)
            workspace.frames += 1
            rendered = None
            if recorded.set_view(self._view, queue):
                rendered = recorded.submit(queue, resident.count)
            rendered = rendered or self._render_again(resident, self._view)
            workspace.finish()
            workspace.pool.release(rendered.acquired.items())
        return rendered.timings()
