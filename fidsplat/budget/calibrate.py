"""Errors and times of qualities, measured on the user's own device and scene."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.accuracy import doubt, errors, judge_for, truth
from fidsplat.cameras import Camera
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.splats import SplatCloud

REPEATS = 9
"""frames of each quality that are timed, in turn with those of the others"""
FEWEST = 3
PATIENCE_MS = 10_000.0
"""what timing several qualities may take in all; where it would take longer, fewer frames are timed, but
`FEWEST` of each"""


@dataclass(frozen=True)
class Times:
    """Milliseconds of a frame whose splats are on the device and whose picture stays there."""

    median: float
    late: float
    """90th percentile"""

    @classmethod
    def of(cls, taken: Sequence[float]) -> Times:
        """From the times of single frames."""
        return cls(float(np.median(taken)), float(np.quantile(taken, 0.9)))


class Calibration:
    """One scene on one device.

    Args:
        renderer: who draws.
        cloud: what.
        camera: from where.
        base: whose definition the truth has.
        around: background, motion, shutter, fog, as `Renderer.render` takes them.
        tell: is told what is being done.
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
        begun = time.perf_counter()
        frame = self.renderer.render(self._resident, self._camera, ("rgb",), quality, **self._around)
        assert frame.timings is not None  # it waits for the device
        return 1e3 * (time.perf_counter() - begun)

    def times(self, qualities: Iterable[Quality], repeats: int = REPEATS) -> list[Times]:
        """Times of qualities that this device draws. Frames take turns, so that what disturbs one disturbs
        all; one of each goes before those that count."""
        several = list(qualities)
        self._tell(f"timing {len(several)} settings")
        first = sum(self.time(quality) for quality in several)
        repeats = max(FEWEST, min(repeats, int(PATIENCE_MS / first)))
        taken = [[self.time(quality) for quality in several] for _ in range(repeats)]
        return [Times.of([row[k] for row in taken]) for k in range(len(several))]
