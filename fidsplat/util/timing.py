"""One way to time things: whoever is compared takes turns with the others, so that what disturbs one disturbs
all.

    ours, theirs = Timer(draw_ours), Timer(draw_theirs)
    take_turns([ours, theirs], rounds=20)
    ours.median, theirs.quartiles, ratios(ours, theirs)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.util.errors import FidsplatError

WARM_UP = 2
"""rounds that go before those that count"""


class Clock:
    """A clock in seconds that what is measured moves on itself: a stage by the device's clock, or a part of a
    child process."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


class Timer:
    """Something to be timed, and the times of its runs so far."""

    def __init__(
        self,
        work: Callable[[], Any],
        clock: Callable[[], float] = time.perf_counter,
        drops_out: bool = False,
        parts: Callable[[Any], Mapping[str, float]] | None = None,
    ) -> None:
        """
        Args:
            work: does it once and ends when it is done. It may return milliseconds by name, which are kept
                beside the whole.
            clock: seconds.
            parts: gives those milliseconds from what `work` returns, as `frame.timings`; not timed itself.
            drops_out: whether a FidsplatError of `work` ends its part and is kept in `error`; else it is
                raised.
        """
        self._work, self._clock, self._drops_out, self._parts = work, clock, drops_out, parts
        self.ms: list[float] = []
        """milliseconds of each run that counts"""
        self.parts: dict[str, list[float]] = {}
        """the same runs part by part, as `work` returned them"""
        self.error = ""

    def run(self, counts: bool = True) -> float:
        """Do it once; returns milliseconds, NaN once it has dropped out."""
        if self.error:
            return math.nan
        try:
            begun = self._clock()
            parts = self._work()
            taken = 1e3 * (self._clock() - begun)
            if self._parts is not None:
                parts = self._parts(parts)
        except FidsplatError as error:
            if not self._drops_out:
                raise
            self.error = str(error)
            return math.nan
        if counts:
            self.ms.append(taken)
            for name, ms in parts.items() if isinstance(parts, Mapping) else ():
                self.parts.setdefault(name, []).append(ms)
        return taken

    @property
    def median(self) -> float:
        """Of the runs that count; NaN without any."""
        return float(np.median(self.ms)) if self.ms else math.nan

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """First quartile, median and third quartile."""
        return quartiles(self.ms)

    @property
    def part_medians(self) -> dict[str, float]:
        """Median of each part."""
        return {name: float(np.median(times)) for name, times in self.parts.items()}


def frame_timer(renderer, scene, camera, drops_out: bool = False, **how) -> Timer:
    """Times frames of a scene that is on the device; the picture stays there. A time is from the call until
    the device is done, its parts are the stages by the device's own clock.

    Args:
        renderer, scene, camera, how: as in `renderer.render(scene, camera, **how)`.
    """
    draw = lambda: renderer.render(scene, camera, **how).wait()  # noqa: E731
    return Timer(draw, drops_out=drops_out, parts=lambda frame: frame.timings)


def take_turns(
    timers: Sequence[Timer],
    rounds: int,
    *,
    least: int | None = None,
    seconds: float = math.inf,
    warm_up: int = WARM_UP,
    tick: Callable[[], None] = lambda: None,
) -> None:
    """Run all timers once a round, and every second round in the opposite order.

    Args:
        rounds: how many count, at most.
        least, seconds: once `least` rounds are done, no more are begun after so many seconds.
        warm_up: rounds that go before and do not count.
        tick: is called after each run that counts.
    """
    for _ in range(warm_up):
        for timer in timers:
            timer.run(counts=False)
    end = time.monotonic() + seconds
    for number in range(rounds):
        if number >= (rounds if least is None else least) and time.monotonic() >= end:
            break
        for timer in timers[:: -1 if number % 2 else 1]:
            timer.run()
            tick()


def ratios(ours: Timer, base: Timer) -> list[float]:
    """Time of `ours` over that of `base`, round by round."""
    return np.divide(ours.ms, base.ms).tolist()


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """First quartile, median and third quartile of at least one value."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return float(low), float(middle), float(high)
