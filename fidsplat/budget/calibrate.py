"""Errors and times of qualities, measured on the user's own device and scene."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.accuracy import doubt, errors, judge_for, truth
from fidsplat.cameras import Camera
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
        camera: from where.
        base: whose definition the truth has.
        around: background, motion, shutter, fog, as `Renderer.render` takes them.
        tell: called with what is being done.
    """

    def __init__(
        self,
        renderer: Renderer,
        cloud: SplatCloud,
        camera: Camera,
        base: Quality,
        around: dict[str, Any],
        tell: Callable[[str], None],
    ) -> None:
        self.renderer, self.base = renderer, base
        self._cloud, self._camera, self._around, self._tell = cloud, camera, around, tell
        self._resident = renderer.upload(cloud)
        self._errors: dict[Quality, float] = {}

    @cached_property
    def _truth(self) -> tuple[np.ndarray, float]:
        """The picture (h, w, 3), and how far it may be off itself."""
        self._tell("drawing the picture at full precision")
        about = self._camera, self._around.get("fog")
        judge = judge_for(self.renderer, *about)
        scene = self._resident if judge is self.renderer else self._cloud
        picture = truth(judge, scene, self._camera, self.base, **self._around)
        return picture, doubt(judge, *about)

    def error(self, quality: Quality) -> float:
        """Largest absolute error of rgb against the truth. What the truth may be off itself is added."""
        if quality not in self._errors:
            want, off = self._truth
            self._tell(f"measuring errors ({len(self._errors) + 1} settings so far)")
            frame = self.renderer.render(self._resident, self._camera, ("rgb",), quality, **self._around)
            self._errors[quality] = errors(frame["rgb"], want).maximum + off
        return self._errors[quality]

    def time(self, quality: Quality) -> float:
        """Milliseconds of one frame, now."""
        return self.timer(quality).run()

    def times(self, qualities: Iterable[Quality], repeats: int = REPEATS) -> list[Times]:
        """Times of qualities that this device draws. Frames take turns; one of each goes before those that
        count."""
        timers = [self.timer(quality) for quality in qualities]
        self._tell(f"timing {len(timers)} settings")
        take_turns(timers, repeats, least=min(FEWEST, repeats), seconds=PATIENCE, warm_up=1)
        return [Times(timer.median, float(np.quantile(timer.ms, 0.9))) for timer in timers]

    def timer(self, quality: Quality) -> Timer:
        """Times frames of a quality."""
        how = {"outputs": ("rgb",), "quality": quality, **self._around}
        return frame_timer(self.renderer, self._resident, self._camera, **how)
