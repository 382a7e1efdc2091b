"""Interleaved timing: functions run alternately, so that disturbances affect all of them.

```python
ours, theirs = Timer(render_ours), Timer(render_theirs)
time_interleaved([ours, theirs], rounds=20)
ours.median, theirs.quartiles, ratios(ours, theirs)
```
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.util.errors import FidsplatError

WARM_UP = 2
"""rounds before the timed ones"""


class Clock:
    """A clock in seconds that the timed work advances, for times by the device or a child process."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


class Timer:
    """A function to time, and the times of its runs."""

    def __init__(
        self,
        work: Callable[[], Any],
        clock: Callable[[], float] = time.perf_counter,
        catch_errors: bool = False,
        parts: Callable[[Any], Mapping[str, float]] | None = None,
    ) -> None:
        """work: function that returns when the work is complete; it may return milliseconds of its parts by
        name. clock: time in seconds. catch_errors: store a FidsplatError of `work` in `error` and stop timing
        it. parts: function that converts the result of `work` to milliseconds by name; not timed."""
        self._work, self._clock, self._catch_errors, self._parts = work, clock, catch_errors, parts
        self.ms: list[float] = []
        """milliseconds of each timed run"""
        self.parts: dict[str, list[float]] = {}
        """milliseconds of each part of the timed runs"""
        self.error = ""

    def run(self, timed: bool = True) -> float:
        """Run once; returns milliseconds, or NaN after an error."""
        if self.error:
            return math.nan
        try:
            begun = self._clock()
            parts = self._work()
            milliseconds = 1e3 * (self._clock() - begun)
            if self._parts is not None:
                parts = self._parts(parts)
        except FidsplatError as error:
            if not self._catch_errors:
                raise
            self.error = str(error)
            return math.nan
        if timed:
            self.ms.append(milliseconds)
            for name, ms in parts.items() if isinstance(parts, Mapping) else ():
                self.parts.setdefault(name, []).append(ms)
        return milliseconds

    @property
    def median(self) -> float:
        """Median of the timed runs; NaN without any."""
        return float(np.median(self.ms)) if self.ms else math.nan

    @property
    def quartiles(self) -> tuple[float, float, float]:
        """First quartile, median and third quartile."""
        return quartiles(self.ms)

    @property
    def part_medians(self) -> dict[str, float]:
        """Median of each part."""
        return {name: float(np.median(times)) for name, times in self.parts.items()}


def frame_timer(
    renderer,
    scene,
    camera,
    catch_errors: bool = False,
    clock: Callable[[], float] = time.perf_counter,
    **how,
) -> Timer:
    """A timer of `renderer.render(scene, camera, **how)` with the frame left on the device. A run ends when
    the device is done; its parts are the stages, by the device's clock."""
    render = lambda: renderer.render(scene, camera, **how).wait()  # noqa: E731
    return Timer(render, clock, catch_errors, parts=lambda frame: frame.timings)


def time_interleaved(
    timers: Sequence[Timer],
    rounds: int,
    *,
    min_rounds: int | None = None,
    seconds: float = math.inf,
    warm_up: int = WARM_UP,
    tick: Callable[[], None] = lambda: None,
) -> None:
    """Run all timers once per round, in reversed order every second round.

    rounds: maximum number of timed rounds. min_rounds, seconds: after `min_rounds` rounds, none is started
    later than `seconds`. warm_up: number of rounds before the timed ones. tick: called after each timed run.
    """
    for _ in range(warm_up):
        for timer in timers:
            timer.run(timed=False)
    end = time.monotonic() + seconds
    for number in range(rounds):
        if number >= (rounds if min_rounds is None else min_rounds) and time.monotonic() >= end:
            break
        for timer in timers[:: -1 if number % 2 else 1]:
            timer.run()
            tick()


def ratios(ours: Timer, base: Timer) -> list[float]:
    """Time of `ours` divided by the time of `base`, for each round."""
    return np.divide(ours.ms, base.ms).tolist()


def quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    """First quartile, median and third quartile of at least one value."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return float(low), float(middle), float(high)
