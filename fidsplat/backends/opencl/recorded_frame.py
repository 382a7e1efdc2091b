"""Frame replay: the command list of a frame is submitted again for another view of the same cloud. Only
output images and arguments of the view are set, which is much faster than planning a frame. On a CPU the host
reads the counts before the lists are written, as in `render_sort_first`.
"""

from __future__ import annotations

import weakref
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.cloud import OpenCLCloud
from fidsplat.backends.opencl.command_list import CommandList
from fidsplat.backends.opencl.counts import COUNTERS, Capacity, Counts, enlarged, read_stats
from fidsplat.backends.opencl.device_frame import DeviceFrame, Rendered
from fidsplat.backends.opencl.memory_plan import MemoryPlan
from fidsplat.backends.opencl.uniforms import view_arguments
from fidsplat.backends.view import View

_UPLOADS = 64
"""maximum number of pending copies to the device"""
_ZERO = np.zeros(1, np.uint32)


class RecordedFrame:
    """Memory plan, and after `record` the command list, of the frames of one cloud and size. The arguments of
    the command list differ between views. A RecordedFrame must not reference the cloud, which caches it."""

    def __init__(self, plan: MemoryPlan, commands: CommandList) -> None:
        self.plan, self.commands = plan, commands
        self.generation: object = None
        """`BufferPool.generation` of the bound scratch buffers; None if `commands` is not complete"""

    def record(self, frame: DeviceFrame) -> None:
        """Take over the arguments and buffer sizes of a frame that was launched by `commands`."""
        self.plan, self.workspace, self.capacity = frame.plan, frame.workspace, frame.capacity
        self._waits = frame.waits
        """whether the host waits for the counts of each frame"""
        self._rows, self._counter_bytes = frame.rows, frame.pool.size("counters")
        if frame.waits:
            pairs = min(frame.pool.size("lists") // 4, frame.workspace.pair_budget)
            self.capacity, self._counter_bytes = Capacity(self.capacity.big, pairs), 4 * COUNTERS
        self.launches_until_counts = frame.launches_until_counts
        self._stages, self._source = self.commands.stages, frame.source
        self._view, self._arrays = frame.view, frame.arrays
        self._uploads: deque[cl.Event] = deque(frame.uploads, maxlen=_UPLOADS)
        self._acquired_sizes = [(name, buffer.size) for name, buffer in frame.acquired.items()]
        self._scratch_names = [name for name in frame.named if name not in frame.acquired]
        self.generation = frame.pool.generation

    def set_view(self, view: View, queue: cl.CommandQueue) -> bool:
        """Bind the uniforms of a view. Returns False if there is no recording, or if a scratch buffer was
        replaced: the frame must be recorded then."""
        if self.generation is None or self.generation is not self.workspace.pool.generation:
            return False
        pool = self.workspace.pool
        if view is not self._view:
            scalars, self._arrays = view_arguments(view, self._source, self._rows)
            self.commands.set(scalars)
            self._view = view
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
            stats = partial(
                read_stats, self.workspace.read_queue, acquired["frame_counts"], events[-1], splats
            )
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

    def replay_into(self, frame: DeviceFrame) -> None:
        """Replay the bound view, and bind its buffers to `frame` for the backward pass."""
        rendered = self.submit(frame.queue, frame.cloud.count)
        assert rendered is not None  # on CPUs frames with derivatives are not replayed
        frame.acquired, events = rendered.acquired, rendered.events
        for name in self._scratch_names:
            if (buffer := frame.pool.get(name)) is not None:
                frame.named[name] = buffer
        frame.named |= frame.acquired
        frame.scalars["big_capacity"], frame.pairs = self.capacity.big, self.capacity.pairs
        frame.events, frame.stages = events, self._stages.copy()
        frame.counted, frame.stats = events[self.launches_until_counts - 1], rendered.stats


class Replay:
    """A frame replayed on a GPU; its counts are compared with the capacity when it is first read."""

    def __init__(
        self,
        recorded: RecordedFrame,
        cloud: OpenCLCloud,
        view: View,
        render_again: Callable[[OpenCLCloud, View], Rendered],
    ) -> None:
        """render_again: function that renders the view with sufficient buffers."""
        self._recorded, self._view, self._render_again = recorded, view, render_again
        self._frame_number, self._capacity = recorded.workspace.frames, recorded.capacity
        self._cloud: OpenCLCloud | None = cloud
        self._weak_cloud = weakref.ref(cloud)

    def render_on_overflow(self, rendered: Rendered) -> Rendered | None:
        """Render the frame again if its counts exceed the capacity; None if it is complete."""
        cloud, workspace = self._cloud, self._recorded.workspace
        if cloud is None:
            return None
        queue, after = rendered.queue, None  # faster than waiting from another queue
        if workspace.frames != self._frame_number:  # later frames were submitted: do not wait for them
            queue.flush()
            queue, after = workspace.read_queue, rendered.events[-1:]
        counts = Counts.read(queue, rendered.acquired["frame_counts"], after)
        complete = None if self._capacity.holds(counts) else self._render_again(cloud, self._view)
        self._cloud = None  # release the cloud, which is no longer needed
        return complete

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage, from another replay with profiling; empty if the cloud was released."""
        cloud, recorded, workspace = self._weak_cloud(), self._recorded, self._recorded.workspace
        if cloud is None:
            return {}
        with workspace.rendering():
            queue = workspace.switch_to(workspace.queue)
            workspace.frames += 1
            rendered = None
            if recorded.set_view(self._view, queue):
                rendered = recorded.submit(queue, cloud.count)
            rendered = rendered or self._render_again(cloud, self._view)
            workspace.finish()
            workspace.pool.release(rendered.acquired.items())
        return rendered.timings()
