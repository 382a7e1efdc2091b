"""Launches: all at once on CUDA, in pieces over threads on the CPU, with the time of each stage."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

from fidsplat.backends.warp.runtime import load

BLOCK = 256
"""threads of a block on a GPU, where nothing else is said"""
_SMALLEST = 2048
"""threads of a kernel below which a piece of a CPU launch is not worth its call"""


@cache
def _arguments(kernel: Any) -> tuple[str, ...]:
    return tuple(argument.label for argument in kernel.adj.args)


def _bound(kernel: Any, given: Mapping[str, Any], first: int = 0) -> list[Any]:
    """The kernel's arguments from `first` on, by the names in its signature."""
    return [given[name] for name in _arguments(kernel)[first:]]


class Commands:
    """Launches on one device, kept from picture to picture: what has not changed since the last need not be
    packed again.
    """

    def __init__(self, device: Any, threads: int) -> None:
        """threads: of the host, over which launches on the CPU are cut."""
        self.device, self.threads = device, threads
        # Warp runs a CPU launch on the thread that calls it, without the interpreter's lock
        self.workers = None if device.is_cuda else ThreadPoolExecutor(threads, "fidsplat-warp")
        self._wp = load()
        self._held: dict[tuple[Any, int], tuple[Any, list[Any], list[int]]] = {}

    def forget(self) -> None:
        """Lets go of the arrays of the last launches."""
        self._held.clear()

    def launch(self, kernel: Any, count: int, args: list[Any], block: int = BLOCK) -> None:
        """`count` threads of a kernel, in blocks of `block` on a GPU."""
        held = self._held.get((kernel, block))
        if held is None:
            options = {"device": self.device, "block_dim": block, "record_tape": False, "record_cmd": True}
            command = self._wp.launch(kernel, count, args, **options)
            self._held[kernel, block] = command, list(args), [count]
        else:
            command, before, dim = held
            for place, value in enumerate(args):
                if value is not before[place]:
                    command.set_param_at_index(place, value)
                    before[place] = value  # kept alive: the command has its address only
            if dim[0] != count:
                command.set_dim(count)
                dim[0] = count
        command.launch()


class Launcher:
    """Launches of one picture. Arguments are given by the names that a kernel's signature has for them."""

    def __init__(self, commands: Commands, timed: bool = True, whole: bool = False) -> None:
        """timed: its stages are. whole: launches on the CPU are not cut, since a capture sees one thread."""
        self._wp, self.timed = load(), timed
        self._device, self._workers, self._commands = commands.device, commands.workers, commands
        self.pieces = 1 if whole else 8 * commands.threads
        """into which a CPU launch is cut, so that threads share uneven work"""
        self._stream = None if self._workers else self._device.stream  # which may be another one later
        self._marks: list[tuple[str | None, Any]] = []

    def launch(self, kernel: Any, count: int, given: Mapping[str, Any], block: int = BLOCK) -> None:
        """`count` threads of a kernel whose first argument is the number of thread 0."""
        args = _bound(kernel, given, 1)
        if self._workers is None:
            self._commands.launch(kernel, count, [0, *args], block)
            return
        pieces = min(self.pieces, -(-count // _SMALLEST))
        cuts = [count * k // pieces for k in range(pieces + 1)]
        self._each(kernel, [(first, end - first, [first, *args]) for first, end in pairwise(cuts)])

    def once(self, kernel: Any, count: int, given: Mapping[str, Any], block: int = BLOCK) -> None:
        """`count` threads in one piece, whatever the device; all arguments are given."""
        self._commands.launch(kernel, count, _bound(kernel, given), block)

    def tiles(self, kernel: Any, first: int, end: int, area: int, given: Mapping[str, Any]) -> None:
        """A CPU thread for each tile; the kernel's first argument is the first tile of a piece, its last the
        first of the `area` samples of state that the piece has.
        """
        pieces = min(self.pieces, end - first)
        cuts = [first + (end - first) * k // pieces for k in range(pieces + 1)]
        args = _bound(kernel, {**given, "state_first": 0}, 1)[:-1]
        spans = enumerate(pairwise(cuts))
        self._each(kernel, [(k, b - a, [a, *args, k * area]) for k, (a, b) in spans])

    def _each(self, kernel: Any, pieces: list[tuple[int, int, list[Any]]]) -> None:
        wp, device = self._wp, self._device

        def run(piece: tuple[int, int, list[Any]]) -> None:
            wp.launch(kernel, piece[1], piece[2], device=device, record_tape=False)

        if len(pieces) == 1:
            self._commands.launch(kernel, *pieces[0][1:])
        elif self._workers is not None:
            list(self._workers.map(run, pieces))  # a piece that fails raises here

    def read_back(self, totals: Any, host: Any) -> list[int]:
        """A few integers from the device by way of `host`, as long: waits for all that was launched."""
        self._wp.copy(host, totals)
        self.finish()
        return host.numpy().tolist()

    def finish(self) -> None:
        """Waits for all that was launched."""
        if self._stream is not None:
            self._wp.synchronize_stream(self._stream)

    def stage(self, name: str | None) -> None:
        """What is launched from here on belongs to the stage `name`; None ends the last."""
        if not self.timed:
            return
        if self._workers is None:
            mark = self._wp.Event(self._device, enable_timing=True)
            self._wp.record_event(mark)
        else:
            mark = time.perf_counter()
        self._marks.append((name, mark))

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage, in the order in which they ran first."""
        timings: dict[str, float] = {}
        for (name, begin), (_, end) in pairwise(self._marks):
            if name is None:  # between a picture and its derivatives
                continue
            if self._workers is None:
                took = self._wp.get_event_elapsed_time(begin, end)
            else:
                took = (end - begin) * 1e3
            timings[name] = timings.get(name, 0.0) + took
        return timings
