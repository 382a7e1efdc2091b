"""Which candidates of the price list to take, by measuring their errors and times on the user's own device
and scene."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.accuracy.error import error_bound, errors, reference_for, truth
from fidsplat.accuracy.price_list import Candidate
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.timing import Timer, frame_timer, take_turns

REPEATS = 9
"""frames of each quality that are timed, in turn with those of the others"""
FEWEST = 3
PATIENCE = 10.0
"""seconds that timing several qualities may take in all; where it would take longer, fewer frames are timed,
but `FEWEST` of each"""
ENOUGH = 4
"""candidates that are timed together before one is taken"""
TOO_LONG = 1.5
"""times of the allowed time: a candidate whose first frame takes longer is timed no further"""
SHORT = 0.5
"""times of the allowed time: candidates that should take less by the list are tried last"""
LUCK = 4.0
"""how many times better than in proportion to the list a candidate may do in this scene"""


@dataclass(frozen=True)
class Times:
    """Milliseconds of a frame whose splats are on the device and whose picture stays there."""

    median: float
    late: float
    """90th percentile"""


class Calibration:
    """One scene on one device.

    Args:
        renderer: who draws.
        cloud: what.
        capture: how; its quality has the definition of the truth.
        tell: called with what is being done.
    """

    def __init__(
        self,
        renderer: Renderer,
        cloud: SplatCloud | Scene,
        capture: Capture,
        tell: Callable[[str], None],
    ) -> None:
        self.renderer, self.base = renderer, capture.quality
        self._cloud, self._capture, self._tell = cloud, capture, tell
        self._resident = renderer.upload(cloud)
        self._errors: dict[Quality, float] = {}

    @cached_property
    def _truth(self) -> tuple[np.ndarray, float]:
        """The picture (h, w, 3), and how far it may be off itself."""
        self._tell("drawing the picture at full precision")
        reference = reference_for(self.renderer, self._capture)
        scene = self._resident if reference is self.renderer else self._cloud
        image = truth(reference, scene, self._capture)
        # what floats of 32 bits are off grows with the values
        return image, error_bound(reference, self._capture) * max(1.0, float(np.abs(image).max(initial=0.0)))

    def error(self, quality: Quality) -> float:
        """Largest absolute error of rgb against the truth. What the truth may be off itself is added."""
        if quality not in self._errors:
            want, off = self._truth
            self._tell(f"measuring errors ({len(self._errors) + 1} candidates so far)")
            frame = self.renderer.render(self._resident, self._capture, quality=quality)
            self._errors[quality] = errors(frame["rgb"], want).maximum + off
        return self._errors[quality]

    def time(self, quality: Quality) -> float:
        """Milliseconds of one frame, now."""
        return self.timer(quality).run()

    def times(self, qualities: Iterable[Quality], repeats: int = REPEATS) -> list[Times]:
        """Times of qualities that this device draws. Frames take turns; one of each goes before those that
        count."""
        timers = [self.timer(quality) for quality in qualities]
        self._tell(f"timing {len(timers)} candidates")
        take_turns(timers, repeats, least=min(FEWEST, repeats), seconds=PATIENCE, warm_up=1)
        return [Times(timer.median, float(np.quantile(timer.ms, 0.9))) for timer in timers]

    def timer(self, quality: Quality) -> Timer:
        """Times frames of a quality."""
        return frame_timer(self.renderer, self._resident, self._capture, quality=quality)


@dataclass(frozen=True)
class Found:
    """A candidate that keeps its bound."""

    candidate: Candidate
    quality: Quality
    error: float
    """largest absolute error of rgb"""
    times: Times


class Search:
    """Settings, the cheapest first, and a scene on a device to measure them with."""

    def __init__(self, calibration: Calibration, candidates: tuple[Candidate, ...]) -> None:
        self.calibration, self._candidates = calibration, candidates
        self.device = calibration.renderer.device.name

    def cheapest_within(self, error: float) -> Found:
        """The fastest here of the first few candidates within the error.

        Raises:
            InputError: none is; it says which error is the least.
        """
        hits: list[tuple[Candidate, float]] = []
        missed: tuple[Candidate, float] | None = None
        for candidate in self._candidates:
            # what does not come near the error in the easiest scenes is not tried, nor what is hardly better
            # than the last that missed it
            if candidate.easy > LUCK * error or (missed and not _much_better(candidate, *missed)):
                continue
            for drawn, measured in self._measured([candidate]):
                if measured <= error:
                    hits.append((drawn, measured))
                else:
                    missed = candidate, error / measured
            if len(hits) == ENOUGH:
                break
        best = sorted(self._candidates, key=lambda candidate: candidate.median)[:ENOUGH]
        finest = [] if hits else list(self._measured(best))  # of which some may have been passed over
        hits = hits or [(drawn, measured) for drawn, measured in finest if measured <= error]
        if hits:
            return min(self._timed(hits), key=lambda found: found.times.median)
        least = min(measured for _, measured in finest)
        raise InputError(
            f"no quality keeps an error of {error:g} for this scene on {self.device}: the least is "
            f"{least:.2g}; allow {least * 1.1:.2g} or more"
        )

    def most_accurate_in(self, ms: float) -> Found:
        """The candidate with the least error of those that draw nine frames of ten in `ms` milliseconds.

        Raises:
            InputError: none does; it says how long the fastest takes.
        """
        seen: list[Found] = []
        start = self._start(ms)
        for group in (self._candidates[start:], self._candidates[:start]):
            likely = self._likely(group, ms)
            for at in range(0, len(likely), ENOUGH):
                seen += self._timed(likely[at : at + ENOUGH])
                in_time = [found for found in seen if found.times.late <= ms]
                if in_time:
                    return min(in_time, key=lambda found: found.error)
        # a second look at what was the fastest: on a busy machine the first may have been unlucky
        pairs = [(found.candidate, found.error) for found in sorted(seen, key=_late)]
        if not pairs:
            pairs = list(itertools.islice(self._measured(self._candidates), ENOUGH))
        best = min(self._timed(pairs[:ENOUGH]), key=_late)
        if best.times.late <= ms:
            return best
        raise InputError(
            f"no quality draws this scene in {ms:g} ms on {self.device}; the fastest takes "
            f"{best.times.late:.3g} ms, with an error of {best.error:.2g}"
        )

    def _start(self, ms: float) -> int:
        """Which candidate to begin with: the first that should take more than a `SHORT` part of the time."""
        usual = min(self._candidates, key=lambda candidate: abs(math.log(candidate.cost))).everywhere
        (taken,) = self.calibration.times([usual.of(self.calibration.base)], FEWEST)
        costs = [candidate.cost * taken.median / usual.cost for candidate in self._candidates]
        start = next((k for k, cost in enumerate(costs) if cost >= SHORT * ms), len(costs))
        return max(0, min(start, len(costs) - 2 * ENOUGH))

    def _likely(self, group: Iterable[Candidate], ms: float) -> list[tuple[Candidate, float]]:
        """Of candidates, the cheapest first, those whose first frame is not much too late; the most accurate
        first."""
        likely, late = [], 0
        for candidate, measured in self._measured(group):
            if self.calibration.time(candidate.of(self.calibration.base)) <= TOO_LONG * ms:
                likely.append((candidate, measured))
            else:
                late += 1
            if late == ENOUGH:
                break
        return sorted(likely, key=lambda pair: pair[1])

    def _measured(self, candidates: Iterable[Candidate]):
        """Settings with their errors, as they are asked for; without the knobs that the device lacks."""
        for candidate in candidates:
            try:
                measured = self.calibration.error(candidate.of(self.calibration.base))
            except (InputError, DeviceError):
                if candidate == candidate.everywhere:
                    raise
                candidate = candidate.everywhere
                measured = self.calibration.error(candidate.of(self.calibration.base))
            yield candidate, measured

    def _timed(self, pairs: list[tuple[Candidate, float]]) -> list[Found]:
        qualities = [candidate.of(self.calibration.base) for candidate, _ in pairs]
        times = self.calibration.times(qualities)
        return [
            Found(candidate, quality, measured, taken)
            for (candidate, measured), quality, taken in zip(pairs, qualities, times, strict=True)
        ]


def _late(found: Found) -> float:
    return found.times.late


def _much_better(candidate: Candidate, missed: Candidate, wanted: float) -> bool:
    """Whether a candidate can have `wanted` times the error of one that missed: by the list's median, which
    the cut-off decides, or by its largest error, which the stop does."""
    enough = LUCK * wanted
    return candidate.median <= enough * missed.median or candidate.most <= enough * missed.most
