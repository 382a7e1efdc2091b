"""Launches: all at once on CUDA, in pieces over threads on the CPU, with the time of each stage."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from fidsplat.backends.warp import runtime

if TYPE_CHECKING:
    from fidsplat.backends.warp.backend import WarpBackend

_SMALLEST = 2048
"""threads of a kernel below which a piece of a CPU launch is not worth its call"""


class Launcher:
    """Launches of one picture."""

    def __init__(self, backend: WarpBackend) -> None:
        self._wp = runtime.load()
        self._device, self._workers = backend.device, backend.workers
        self.pieces = 8 * backend.threads
        """into which a CPU launch is cut, so that threads share uneven work"""
        self._marks: list[tuple[str | None, Any]] = []

    def launch(self, kernel: Any, count: int, *args: Any) -> None:
        """`count` threads of a kernel whose first argument is the number of thread 0."""
        if self._workers is None:
            self._wp.launch(kernel, count, [0, *args], device=self._device, record_tape=False)
            return
        pieces = min(self.pieces, -(-count // _SMALLEST))
        cuts = [count * k // pieces for k in range(pieces + 1)]
        self._each(kernel, [(first, end - first, [first, *args]) for first, end in zip(cuts, cuts[1:], strict=False)])

    def blocks(self, kernel: Any, count: int, block: int, *args: Any) -> None:
        """`count` threads in blocks of `block`."""
        self._wp.launch(kernel, count, list(args), device=self._device, block_dim=block, record_tape=False)

    def tiles(self, kernel: Any, first: int, end: int, area: int, *args: Any) -> None:
        """A CPU thread for each tile; each piece has its own `area` samples of the state, the last argument."""
        pieces = min(self.pieces, end - first)
        cuts = [first + (end - first) * k // pieces for k in range(pieces + 1)]
        spans = enumerate(zip(cuts, cuts[1:], strict=False))
        self._each(kernel, [(k, b - a, [a, *args, k * area]) for k, (a, b) in spans])

    def _each(self, kernel: Any, pieces: list[tuple[int, int, list[Any]]]) -> None:
        wp, device = self._wp, self._device

        def run(piece: tuple[int, int, list[Any]]) -> None:
            wp.launch(kernel, piece[1], piece[2], device=device, record_tape=False)

        if len(pieces) == 1 or self._workers is None:
            for piece in pieces:
                run(piece)
        else:
            list(self._workers.map(run, pieces))  # a piece that fails raises here

    def read_back(self, totals: Any) -> list[int]:
        """A few integers from the device: waits for all that was launched."""
        return [int(value) for value in totals.numpy()]

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
        for (name, begin), (_, end) in zip(self._marks, self._marks[1:], strict=False):
            if self._workers is None:
                took = self._wp.get_event_elapsed_time(begin, end)
            else:
                took = (end - begin) * 1e3
            timings[str(name)] = timings.get(str(name), 0.0) + took
        return timings
