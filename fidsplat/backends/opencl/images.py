"""Output images on an OpenCL device."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pyopencl as cl

from fidsplat.backends.interface import Images
from fidsplat.backends.opencl.counts import Counts
from fidsplat.backends.opencl.device_frame import DeviceFrame
from fidsplat.backends.opencl.recorded_frame import RecordedFrame
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.uint8 import read_uint8
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects.catalogue import Output


@dataclass
class Rendered:
    """What a submitted frame leaves: its own buffers and events, without the cloud and scratch buffers that
    `DeviceFrame` holds."""

    queue: cl.CommandQueue
    leased: list[tuple[str, cl.Buffer]]
    """output images and counts by name"""
    stats: Callable[[], dict[str, int]]
    last: cl.Event
    """of the last launch"""
    events: list[tuple[str, cl.Event]] | None = None
    """stage and event of each launch; None on a queue without profiling"""
    uploads: list[cl.Event] | None = None
    """kept until the device has read the arrays"""

    @staticmethod
    def of(frame: DeviceFrame, timed: bool = True) -> Rendered:
        """What a frame leaves."""
        events, last = frame.events if timed else None, frame.events[-1][1]
        return Rendered(frame.queue, frame.leased, frame.stats, last, events, frame.uploads)

    def buffer(self, name: str) -> cl.Buffer:
        """A leased buffer."""
        return dict(self.leased)[name]

    def done(self) -> list[cl.Event]:
        """Events that another queue waits for before it reads the images."""
        self.queue.flush()
        return [self.last]

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage."""
        self.queue.finish()
        return _milliseconds(self.events or ())


def _milliseconds(
    events: Iterable[tuple[str, cl.Event]], earlier: Mapping[str, float] | None = None
) -> dict[str, float]:
    """The time of completed launches by stage, added to that of earlier ones."""
    timings = dict(earlier or {})
    for stage, event in events:
        timings[stage] = timings.get(stage, 0.0) + (event.profile.end - event.profile.start) * 1e-6
    return timings


class ReplayingPipeline(Protocol):
    """The part of `OpenCLPipeline` that completes a replayed frame."""

    workspace: Workspace

    def render_again(self, resident: Resident, view: View) -> Rendered:
        """Render with the buffers that the frame requires."""
        ...

    def profile(self, resident: Resident, view: View, recorded: RecordedFrame) -> dict[str, float]:
        """Milliseconds by stage."""
        ...


class Replay:
    """A replayed frame, whose capacity is checked when it is first read."""

    def __init__(
        self, pipeline: ReplayingPipeline, resident: Resident, view: View, recorded: RecordedFrame
    ) -> None:
        self._pipeline, self._view, self._recorded = pipeline, view, recorded
        self._number = pipeline.workspace.frames
        self._resident: Resident | None = resident
        self._timed = weakref.ref(resident)

    def overflow(self, rendered: Rendered) -> Rendered | None:
        """The frame rendered again, if its counts exceed the capacity; None if it is complete."""
        resident, workspace = self._resident, self._pipeline.workspace
        if resident is None:
            return None
        queue, after = rendered.queue, None  # faster than a queue that waits for another
        if workspace.frames != self._number:  # without waiting for frames that were submitted since
            queue, after = workspace.read_queue, rendered.done()
        counts = Counts.read(queue, rendered.buffer("counts"), after)
        complete = self._recorded.capacity.holds(counts)
        again = None if complete else self._pipeline.render_again(resident, self._view)
        self._resident = None  # the cloud is held until the check only
        return again

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage, of another replay with profiling; empty if the cloud was released."""
        resident = self._timed()
        return {} if resident is None else self._pipeline.profile(resident, self._view, self._recorded)


class OpenCLImages(Images):
    """The output images of one picture. Their buffers go back to the pool when nobody holds them any more."""

    def __init__(
        self,
        workspace: Workspace,
        outputs: tuple[Output, ...],
        size: tuple[int, int],
        rendered: Rendered,
        replay: Replay | None = None,
        tiles: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (0, 0)),
        samples: int = 1,
    ) -> None:
        """size: rows and columns of pixels. tiles: rows and columns of them, and samples of one. samples:
        of a pixel, across."""
        self._workspace, self._size, self._rendered, self._replay = workspace, size, rendered, replay
        self._outputs = {output.name: output for output in outputs}
        self._timings: dict[str, float] = {}
        self._tiles, self._samples = tiles, samples
        self._added: list[tuple[dict[str, int], list[tuple[str, cl.Event]]]] = []
        """counts and launches of the pictures of which tiles were taken"""
        self._leased = rendered.leased
        weakref.finalize(self, workspace.pool.give_back, self._leased)

    def read(self, name: str) -> np.ndarray:
        """The image on the host; waits for the device.

        Raises:
            DeviceError: the device has failed, in this or while it was drawing.
        """
        image = self.empty(name)
        self.read_rows(name, 0, len(image), image)
        return image

    def empty(self, name: str) -> np.ndarray:
        """A host array for an image, in memory that copies fast."""
        return self._workspace.host_memory.empty(self._shape(name), self._outputs[name].dtype)

    def _shape(self, name: str) -> tuple[int, ...]:
        channels = self._outputs[name].channels
        return self._size if channels == 1 else (*self._size, channels)

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray) -> None:
        """Copy pixel rows [first, end) alone. Raises DeviceError as `read`."""
        if first == end:
            return
        with self._workspace.failing(f"rendering {name}"):
            rendered, above = self.settle(), first * into[:1].nbytes
            # beside what was put on its queue since: the next picture, say
            queue, image = self._workspace.read_queue, rendered.buffer(f"{name}_out")
            cl.enqueue_copy(queue, into[first:end], image, src_offset=above, wait_for=rendered.done())

    def read_uint8(self, name: str) -> np.ndarray:
        """Copy an image in 8 bits. Raises DeviceError as `read`."""
        with self._workspace.failing(f"rendering {name}"):
            rendered = self.settle()
            image = rendered.buffer(f"{name}_out")
            return read_uint8(self._workspace, image, self._shape(name), rendered.done())

    def termination_depths(self) -> TerminationDepths:
        """Termination depths of a frame with that effect. Raises DeviceError as `read`."""
        with self._workspace.failing("rendering"):
            rendered, (grid, tile) = self.settle(), self._tiles
            keys = np.empty(grid, np.uint32)
            queue = self._workspace.read_queue
            cl.enqueue_copy(queue, keys, rendered.buffer("termination_depths"), wait_for=rendered.done())
        return TerminationDepths.of_keys(keys, tile)

    def take_tiles(self, other: OpenCLImages, tiles: np.ndarray) -> None:
        """Copy tiles of another frame of the same view. Raises DeviceError as `read`."""
        with self._workspace.failing("rendering"):
            own, others = self.settle(), other.settle()
            queue, copied = self._workspace.read_queue, None
            after = [*own.done(), *others.done()]
            for output in self._outputs.values():
                width = 4 * output.channels  # bytes of a pixel
                row_bytes = self._size[1] * width
                source, target = (one.buffer(f"{output.name}_out") for one in (others, own))
                for top, bottom, left, right in self._pixels_of(tiles):
                    region, corner = ((right - left) * width, bottom - top, 1), (left * width, top, 0)
                    pitches = (row_bytes, row_bytes * self._size[0])
                    copied = cl.enqueue_copy(
                        *(queue, target, source),
                        **{"src_origin": corner, "dst_origin": corner, "region": region},
                        **{"src_pitches": pitches, "dst_pitches": pitches, "wait_for": after},
                    )
            if copied is not None:
                copied.wait()  # the other's buffers may be the next picture's
            self._added.append((dict(others.stats()), others.events or []))

    def _pixels_of(self, tiles: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
        """Rectangles [top, bottom) x [left, right) of pixels that together are some tiles, row by row."""
        (rows, columns), (height, width) = self._size, (side // self._samples for side in self._tiles[1])
        for row, wanted in enumerate(tiles):
            sides = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]]).astype(np.int8)))
            for first, end in sides.reshape(-1, 2).tolist():
                yield row * height, min((row + 1) * height, rows), first * width, min(end * width, columns)

    def wait(self) -> None:
        """Until the device has drawn it.

        Raises:
            DeviceError: as `read`.
        """
        with self._workspace.failing("rendering"):
            self.settle().queue.finish()

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds by stage. A picture that was launched again, by which nobody has taken the time, is
        drawn once more for that; the first time that they are asked for."""
        with self._workspace.failing("rendering"):
            rendered = self.settle()
            if rendered.events is not None or self._replay is None:
                return _milliseconds((one for _, events in self._added for one in events), rendered.timings())
            with self._workspace.lock:
                self._timings = self._timings or self._replay.timings()
            return self._timings

    @property
    def stats(self) -> Mapping[str, int]:
        with self._workspace.failing("rendering"):
            stats = dict(self.settle().stats())
            for added, _ in self._added:
                stats = {name: number + added[name] for name, number in stats.items()}
            return stats

    def settle(self) -> Rendered:
        """What is drawn, for certain with room for all of it."""
        if self._replay is not None:
            with self._workspace.lock:
                again = self._replay.overflow(self._rendered)
                if again is not None:
                    self._leased.extend(again.leased)  # given back together
                    self._rendered = again
        return self._rendered
