"""Search for the best candidate by measuring errors and times in a scene on a device."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.accuracy.candidates import Candidate, Choice
from fidsplat.accuracy.error import errors, reference_error, reference_image, reference_renderer
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.timing import Timer, frame_timer, time_interleaved

REPEATS = 9
"""timed frames of each quality; frames of all qualities are interleaved"""
MIN_REPEATS = 3
MAX_SECONDS = 10.0
"""time limit of one comparison of qualities, which still times at least `MIN_REPEATS` frames of each"""
GROUP_SIZE = 4
"""number of candidates that are timed together before one is chosen"""
MAX_FIRST_FRAME = 1.5
"""multiple of the allowed time; candidates whose first frame takes longer are not timed"""
START_FRACTION = 0.5
"""fraction of the allowed time; candidates that are expected to be faster are tried last"""
SCENE_VARIATION = 4.0
"""factor by which a candidate's error in this scene may be below the error that other scenes predict"""


@dataclass(frozen=True)
class Times:
    """Frame time in milliseconds, with splats and image on the device."""

    median: float
    p90: float
    """90th percentile"""


class SceneMeasurement:
    """Errors and times of qualities, measured with one capture of a scene on a device.

    Args:
        capture: its quality defines the reference image.
        report: called with the current step.
    """

    def __init__(
        self,
        renderer: Renderer,
        scene: SplatCloud | Scene,
        capture: Capture,
        report: Callable[[str], None],
    ) -> None:
        self.renderer, self.base = renderer, capture.quality
        self._scene, self._capture, self._report = scene, capture, report
        self._resident = renderer.upload(scene)
        self._errors: dict[Quality, float] = {}

    @cached_property
    def _reference(self) -> tuple[np.ndarray, float]:
        """The reference image (h, w, 3), and a bound on its own error."""
        self._report("rendering at full precision")
        reference = reference_renderer(self.renderer, self._capture)
        scene = self._resident if reference is self.renderer else self._scene
        image = reference_image(reference, scene, self._capture)
        # float32 rounding is relative to the values
        scale = max(1.0, float(np.abs(image).max(initial=0.0)))
        return image, scale * reference_error(reference, self._capture)

    def error(self, quality: Quality) -> float:
        """Largest absolute error of rgb plus the bound on the error of the reference image."""
        if quality not in self._errors:
            reference, reference_bound = self._reference
            self._report(f"measuring errors ({len(self._errors) + 1} candidates so far)")
            frame = self.renderer.render(self._resident, self._capture, quality=quality)
            self._errors[quality] = errors(frame["rgb"], reference).maximum + reference_bound
        return self._errors[quality]

    def time(self, quality: Quality) -> float:
        """Time of one frame in milliseconds."""
        return self.timer(quality).run()

    def times(self, qualities: Iterable[Quality], repeats: int = REPEATS) -> list[Times]:
        """Frame times of qualities, from interleaved frames after one warm-up frame of each."""
        timers = [self.timer(quality) for quality in qualities]
        self._report(f"timing {len(timers)} candidates")
        time_interleaved(
            timers, repeats, min_rounds=min(MIN_REPEATS, repeats), seconds=MAX_SECONDS, warm_up=1
        )
        return [Times(timer.median, float(np.quantile(timer.ms, 0.9))) for timer in timers]

    def timer(self, quality: Quality) -> Timer:
        return frame_timer(self.renderer, self._resident, self._capture, quality=quality)


MeasuredCandidate = tuple[Candidate, float]
"""a candidate that the device supports, and its error in the scene"""


class CandidateSearch:
    """Search among candidates, sorted by cost, by measuring them in a scene."""

    def __init__(self, measurement: SceneMeasurement, candidates: tuple[Candidate, ...]) -> None:
        self.measurement, self._candidates = measurement, candidates
        self.device = measurement.renderer.device.name

    def fastest_within(self, error: float) -> Choice:
        """The fastest of the first `GROUP_SIZE` candidates within the error.

        Raises:
            InputError: no candidate is within the error; the message names the lowest possible error.
        """
        within: list[MeasuredCandidate] = []
        last_exceeding: MeasuredCandidate | None = None
        for candidate in self._candidates:
            # skip candidates that exceed the error even in easy scenes, or that are hardly more accurate than
            # the last candidate that exceeded it
            if candidate.error_easy > SCENE_VARIATION * error:
                continue
            if last_exceeding and not _much_more_accurate(candidate, *last_exceeding):
                continue
            for supported, measured in self._measured([candidate]):
                if measured <= error:
                    within.append((supported, measured))
                else:
                    last_exceeding = candidate, error / measured
            if len(within) == GROUP_SIZE:
                break
        most_accurate: list[MeasuredCandidate] = []
        if not within:  # the finest candidates may have been skipped
            best = sorted(self._candidates, key=lambda candidate: candidate.error_median)[:GROUP_SIZE]
            most_accurate = list(self._measured(best))
            within = [(supported, measured) for supported, measured in most_accurate if measured <= error]
        if within:
            return min(self._timed(within), key=lambda choice: choice.ms or 0.0)
        lowest = min(measured for _, measured in most_accurate)
        raise InputError(
            f"error must be at least {lowest:.2g} for this scene on {self.device}, got {error:g}; allow "
            f"{lowest * 1.1:.2g} or more"
        )

    def most_accurate_in(self, ms: float) -> Choice:
        """The candidate with the lowest error among candidates whose 90th percentile of the frame time is at
        most `ms`.

        Raises:
            InputError: no candidate is fast enough; the message names the time of the fastest.
        """
        timed: list[tuple[MeasuredCandidate, Choice]] = []
        start = self._first_index(ms)
        for group in (self._candidates[start:], self._candidates[:start]):
            fast = self._fast_candidates(group, ms)
            for first in range(0, len(fast), GROUP_SIZE):
                measured_candidates = fast[first : first + GROUP_SIZE]
                timed += zip(measured_candidates, self._timed(measured_candidates), strict=True)
                in_time = [choice for _, choice in timed if p90_ms(choice) <= ms]
                if in_time:
                    return min(in_time, key=lambda choice: choice.error)
        # time the fastest candidates again, since other programs may have delayed their frames
        fastest = [pair for pair, _ in sorted(timed, key=lambda pair: p90_ms(pair[1]))]
        if not fastest:
            fastest = list(itertools.islice(self._measured(self._candidates), GROUP_SIZE))
        best = min(self._timed(fastest[:GROUP_SIZE]), key=p90_ms)
        if p90_ms(best) <= ms:
            return best
        raise InputError(
            f"ms must be at least {p90_ms(best):.3g} for this scene on {self.device}, got {ms:g}; the "
            f"fastest quality has an error of {best.error:.2g}"
        )

    def _first_index(self, ms: float) -> int:
        """Index of the first candidate expected to take at least `START_FRACTION` of the allowed time."""
        typical = min(self._candidates, key=lambda candidate: abs(math.log(candidate.cost))).portable
        (times,) = self.measurement.times([self._quality(typical)], MIN_REPEATS)
        costs = [candidate.cost * times.median / typical.cost for candidate in self._candidates]
        first = next((k for k, cost in enumerate(costs) if cost >= START_FRACTION * ms), len(costs))
        return max(0, min(first, len(costs) - 2 * GROUP_SIZE))

    def _fast_candidates(self, group: Iterable[Candidate], ms: float) -> list[MeasuredCandidate]:
        """Candidates with a first frame within `MAX_FIRST_FRAME` times the allowed time, sorted by error."""
        fast, slow_count = [], 0
        for candidate, measured in self._measured(group):
            if self.measurement.time(self._quality(candidate)) <= MAX_FIRST_FRAME * ms:
                fast.append((candidate, measured))
            else:
                slow_count += 1
            if slow_count == GROUP_SIZE:
                break
        return sorted(fast, key=lambda pair: pair[1])

    def _quality(self, candidate: Candidate) -> Quality:
        return candidate.quality(self.measurement.base)

    def _measured(self, candidates: Iterable[Candidate]) -> Iterator[MeasuredCandidate]:
        """Candidates with their errors; settings that the device lacks are removed."""
        for candidate in candidates:
            try:
                measured = self.measurement.error(self._quality(candidate))
            except (InputError, DeviceError):
                if candidate == candidate.portable:
                    raise
                candidate = candidate.portable
                measured = self.measurement.error(self._quality(candidate))
            yield candidate, measured

    def _timed(self, pairs: list[MeasuredCandidate]) -> list[Choice]:
        """Choices of candidates, with their frame times."""
        qualities = [self._quality(candidate) for candidate, _ in pairs]
        rows = zip(pairs, qualities, self.measurement.times(qualities), strict=True)
        return [
            Choice(quality, error, times.median, times.p90, "measured", self.device, candidate.settings)
            for (candidate, error), quality, times in rows
        ]


def p90_ms(choice: Choice) -> float:
    """90th percentile of the frame time of a measured choice."""
    assert choice.ms_p90 is not None
    return choice.ms_p90


def _much_more_accurate(candidate: Candidate, exceeding: Candidate, factor: float) -> bool:
    """Whether the error of a candidate is probably at most `factor` times the error of `exceeding`.

    The median over the measured scenes depends on the cut-off, the maximum on the stop; a candidate that is
    better in one of them is tried.
    """
    ratio = SCENE_VARIATION * factor
    by_median = candidate.error_median <= ratio * exceeding.error_median
    return by_median or candidate.error_max <= ratio * exceeding.error_max
