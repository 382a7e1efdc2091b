"""Errors and times of qualities, measured on the user's own device and scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.accuracy import error_bound, errors, reference_for, truth
from fidsplat.capture import Capture
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.splats import SplatCloud
from fidsplat.timing import Timer, frame_timer, take_turns

REPEATS = 9
"""frames of each quality that are timed, in turn with those of the others"""
FEWEST = 3
PATIENCE = 10.0
"""seconds that timing several qualities may take in all; where it would take longer, fewer frames are timed,
but `FEWEST` of each"""


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
        cloud: SplatCloud,
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
        return truth(reference, scene, self._capture), error_bound(reference, self._capture)

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
