"""Output images on an OpenCL device."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.counts import fullness_of, read_counts, stats_of
from fidsplat.backends.opencl.picture import Picture
from fidsplat.backends.opencl.recording import Recording
from fidsplat.backends.opencl.resident import Resident
from fidsplat.backends.opencl.uint8 import read_uint8
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects.catalogue import Output


@dataclass
class Drawn:
    """A picture on a queue. Not the `Picture` itself, which holds the cloud and all scratch buffers."""

    queue: cl.CommandQueue
    leased: list[tuple[str, cl.Buffer]]
    """what is the picture's own, by name: output images and, of some ways of listing, counts"""
    stats: Callable[[], dict[str, int]]
    last: cl.Event
    """of its last launch: all of it is drawn then, whatever else is on the queue"""
    events: list[tuple[str, cl.Event]] | None = None
    """of each launch, with its stage; None where nobody has taken the time"""
    uploads: Any = None
    """kept until the device has read them"""

    @staticmethod
    def of(picture: Picture, timed: bool = True) -> Drawn:
        """What a picture leaves."""
        events, last = picture.events if timed else None, picture.events[-1][1]
        return Drawn(picture.queue, picture.leased, picture.stats, last, events, picture.uploads)

    def buffer(self, name: str) -> cl.Buffer:
        """A leased buffer."""
        return dict(self.leased)[name]

    def done(self) -> list[cl.Event]:
        """What is waited for by another queue that reads what it has left."""
        self.queue.flush()
        return [self.last]

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage."""
        self.queue.finish()
        return _milliseconds(self.events or ())


def _milliseconds(
    events: Iterable[tuple[str, cl.Event]], of: Mapping[str, float] | None = None
) -> dict[str, float]:
    """What launches that are done took by stage, and others before them."""
    timings = dict(of or {})
    for stage, event in events:
        timings[stage] = timings.get(stage, 0.0) + (event.profile.end - event.profile.start) * 1e-6
    return timings


class Repeat:
    """A picture that was launched without asking whether there is room for all of it, and how to draw it with
    more."""

    def __init__(
        self,
        draw: Callable[[Resident, View], Drawn],
        time: Callable[[Resident, View, Recording], dict[str, float]],
        workspace: Workspace,
        resident: Resident,
        view: View,
        recording: Recording,
    ) -> None:
        """Made when the picture is launched. draw: draws it again, with the room that it needs. time: tells
        how long its stages take."""
        self._draw, self._time, self._view, self._recording = draw, time, view, recording
        self._workspace, self._number = workspace, workspace.pictures
        self._room = recording.big, recording.capacity
        self._resident: Resident | None = resident
        self._known = weakref.ref(resident)

    def settled(self, drawn: Drawn) -> Drawn | None:
        """Once it is drawn: the picture drawn again, if there was too little room."""
        resident = self._resident
        if resident is None:
            return None
        queue, after = drawn.queue, None  # sooner than a queue that waits for another
        if self._workspace.pictures != self._number:  # beside those that were begun since
            queue, after = self._workspace.read_queue, drawn.done()
        big, pairs = fullness_of(read_counts(queue, drawn.buffer("counts"), after))
        again = None if big <= self._room[0] and pairs <= self._room[1] else self._draw(resident, self._view)
        self._resident = None  # it is held no longer than it may be needed
        return again

    def timings(self) -> dict[str, float]:
        """The picture is drawn once more to take the time; empty if its cloud is gone."""
        resident = self._known()
        return {} if resident is None else self._time(resident, self._view, self._recording)


class OpenCLImages:
    """The output images of one picture. Their buffers go back to the pool when nobody holds them any more."""

    def __init__(
        self,
        workspace: Workspace,
        outputs: tuple[Output, ...],
        size: tuple[int, int],
        drawn: Drawn,
        repeat: Repeat | None = None,
        tiles: tuple[tuple[int, int], tuple[int, int]] = ((0, 0), (0, 0)),
        samples: int = 1,
    ) -> None:
        """size: rows and columns of pixels. tiles: rows and columns of them, and samples of one. samples:
        of a pixel, across."""
        self._workspace, self._size, self._drawn, self._repeat = workspace, size, drawn, repeat
        self._outputs = {output.name: output for output in outputs}
        self._timings: dict[str, float] = {}
        self._tiles, self._samples = tiles, samples
        self._added: list[tuple[dict[str, int], list[tuple[str, cl.Event]]]] = []
        """counts and launches of the pictures of which tiles were taken"""
        self._leased = drawn.leased
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
        """As `ReadsRows`."""
        return self._workspace.host_memory.empty(self._shape(name), self._outputs[name].dtype)

    def _shape(self, name: str) -> tuple[int, ...]:
        channels = self._outputs[name].channels
        return self._size if channels == 1 else (*self._size, channels)

    def read_rows(self, name: str, first: int, end: int, into: np.ndarray) -> None:
        """As `ReadsRows`. Raises DeviceError as `read`."""
        if first == end:
            return
        with self._workspace.failing(f"drawing {name}"):
            drawn, above = self.settle(), first * into[:1].nbytes
            # beside what was put on its queue since: the next picture, say
            queue, image = self._workspace.read_queue, drawn.buffer(f"{name}_out")
            cl.enqueue_copy(queue, into[first:end], image, src_offset=above, wait_for=drawn.done())

    def read_uint8(self, name: str) -> np.ndarray:
        """As `GivesUint8`. Raises DeviceError as `read`."""
        with self._workspace.failing(f"drawing {name}"):
            drawn = self.settle()
            image = drawn.buffer(f"{name}_out")
            return read_uint8(self._workspace, image, self._shape(name), drawn.done())

    def tile_ends(self) -> TerminationDepths:
        """As `GivesTileEnds`, of pictures whose features have the effect. Raises DeviceError as `read`."""
        with self._workspace.failing("drawing"):
            drawn, (grid, tile) = self.settle(), self._tiles
            keys = np.empty(grid, np.uint32)
            queue = self._workspace.read_queue
            cl.enqueue_copy(queue, keys, drawn.buffer("tile_ends"), wait_for=drawn.done())
        return TerminationDepths.of_keys(keys, tile)

    def take_tiles(self, other: OpenCLImages, tiles: np.ndarray) -> None:
        """As `GivesTileEnds`. Raises DeviceError as `read`."""
        with self._workspace.failing("drawing"):
            own, others = self.settle(), other.settle()
            queue, copied = self._workspace.read_queue, None
            after = [*own.done(), *others.done()]
            for output in self._outputs.values():
                width = 4 * output.channels  # bytes of a pixel
                row_bytes = self._size[1] * width
                source, target = (drawn.buffer(f"{output.name}_out") for drawn in (others, own))
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
        with self._workspace.failing("drawing"):
            self.settle().queue.finish()

    @property
    def timings(self) -> dict[str, float]:
        """Milliseconds by stage. A picture that was launched again, by which nobody has taken the time, is
        drawn once more for that; the first time that they are asked for."""
        with self._workspace.failing("drawing"):
            drawn = self.settle()
            if drawn.events is not None or self._repeat is None:
                return _milliseconds((one for _, events in self._added for one in events), drawn.timings())
            with self._workspace.lock:
                self._timings = self._timings or self._repeat.timings()
            return self._timings

    @property
    def stats(self) -> Mapping[str, int]:
        with self._workspace.failing("drawing"):
            stats = dict(self.settle().stats())
            for added, _ in self._added:
                stats = {name: number + added[name] for name, number in stats.items()}
            return stats

    def settle(self) -> Drawn:
        """What is drawn, for certain with room for all of it."""
        if self._repeat is not None:
            with self._workspace.lock:
                again = self._repeat.settled(self._drawn)
                if again is not None:
                    self._leased.extend(again.leased)  # given back together
                    self._drawn = again
        return self._drawn


def stats_later(
    workspace: Workspace, counts: cl.Buffer, last: cl.Event, splats: int
) -> Callable[[], dict[str, int]]:
    """What a frame tells, read from a picture's buffer `counts` when it is wanted. last: of its launches, on
    a queue that is flushed."""
    return lambda: stats_of(splats, read_counts(workspace.read_queue, counts, [last]))
