"""Launches: all at once on CUDA, in pieces over threads on the CPU, with the time of each stage."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

from fidsplat.backends.warp import runtime

if TYPE_CHECKING:
    from fidsplat.backends.warp.backend import WarpBackend

BLOCK = 256
"""threads of a block on a GPU, where nothing else is said"""
_SMALLEST = 2048
"""threads of a kernel below which a piece of a CPU launch is not worth its call"""


class Commands:
    """Launches kept from picture to picture: what has not changed since the last need not be packed again."""

    def __init__(self, device: Any) -> None:
        self._wp, self._device = runtime.load(), device
        self._held: dict[tuple[Any, int], tuple[Any, list[Any], list[int]]] = {}

    def launch(self, kernel: Any, count: int, args: list[Any], block: int = BLOCK) -> None:
        """`count` threads of a kernel, in blocks of `block` on a GPU."""
        held = self._held.get((kernel, block))
        if held is None:
            options = {"device": self._device, "block_dim": block, "record_tape": False, "record_cmd": True}
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
    """Launches of one picture."""

    def __init__(self, backend: WarpBackend) -> None:
        self._wp = runtime.load()
        self._device, self._workers, self._commands = backend.device, backend.workers, backend.commands
        self.pieces = 8 * backend.threads
        """into which a CPU launch is cut, so that threads share uneven work"""
        self._marks: list[tuple[str | None, Any]] = []

    def launch(self, kernel: Any, count: int, *args: Any, block: int = BLOCK) -> None:
        """`count` threads of a kernel whose first argument is the number of thread 0."""
        if self._workers is None:
            self._commands.launch(kernel, count, [0, *args], block)
            return
        pieces = min(self.pieces, -(-count // _SMALLEST))
        cuts = [count * k // pieces for k in range(pieces + 1)]
        self._each(kernel, [(first, end - first, [first, *args]) for first, end in pairwise(cuts)])

    def blocks(self, kernel: Any, count: int, block: int, *args: Any) -> None:
        """`count` threads in blocks of `block`."""
        self._commands.launch(kernel, count, list(args), block)

    def tiles(self, kernel: Any, first: int, end: int, area: int, *args: Any) -> None:
        """A CPU thread for each tile; each piece has `area` samples of the state, the last argument."""
        pieces = min(self.pieces, end - first)
        cuts = [first + (end - first) * k // pieces for k in range(pieces + 1)]
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

    def once(self, kernel: Any, count: int, *args: Any) -> None:
        """`count` threads in one piece, whatever the device."""
        self._commands.launch(kernel, count, list(args))

    def read_back(self, totals: Any, host: Any) -> list[int]:
        """A few integers from the device by way of `host`, as long: waits for all that was launched."""
        self._wp.copy(host, totals)
        if self._workers is None:
            self._wp.synchronize_stream(self._device.stream)
        return host.numpy().tolist()

    def stage(self, name: str | None) -> None:
        """What is launched from here on belongs to the stage `name`; None ends the last."""
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
            if self._workers is None:
                took = self._wp.get_event_elapsed_time(begin, end)
            else:
                took = (end - begin) * 1e3
            timings[str(name)] = timings.get(str(name), 0.0) + took
        return timings
