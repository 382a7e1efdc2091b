"""Candidates of `quality_within`: the Pareto front of quality settings in error and frame time.

`candidates.json` holds them with their measured errors and times (benchmarks/candidates.py).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from fidsplat.capture.quality import Quality

FILE = Path(__file__).with_name("candidates.json")
MARGIN = 1.5
"""ratio of a promised error to the largest measured error, which other scenes may exceed slightly"""

DEFAULTS: dict[str, Any] = {
    "alpha_cutoff": 1.0 / 255.0,
    "transmittance_stop": 1e-4,
    "projection_precision": "float64",
    "arithmetic": "precise",
    "blend_precision": "float32",
}
"""Default values of the quality settings that `quality_within` chooses.

Settings that only add errors (opacity ceiling, exclusive stop) are always off. All other settings define the
image and are copied from the base quality.
"""
PORTABLE = ("alpha_cutoff", "transmittance_stop", "arithmetic")
"""settings of `DEFAULTS` that every device supports"""


@dataclass(frozen=True)
class Candidate:
    """One point of the Pareto front: quality settings with measured error and time."""

    settings: dict[str, Any]
    """settings that differ from `DEFAULTS`"""
    error_easy: float
    """largest absolute error of an image, 5th percentile over the measured scenes"""
    error_median: float
    """largest absolute error of an image, median over the measured scenes"""
    error_max: float
    """largest absolute error of an image, maximum over the measured scenes"""
    cost: float
    """frame time relative to `DEFAULTS` (processor time on CPUs)"""

    def quality(self, base: Quality) -> Quality:
        """The base quality with the accuracy settings of this candidate."""
        return base.with_(**(DEFAULTS | {"opacity_ceiling": 1.0, "stop_rule": "inclusive"} | self.settings))

    @property
    def portable(self) -> Candidate:
        """A copy with the settings in `PORTABLE` only: equally accurate unless this one blends in float64."""
        return replace(self, settings={k: value for k, value in self.settings.items() if k in PORTABLE})


@cache
def load(kind: str) -> tuple[Candidate, ...]:
    """Candidates for a kind of device (cpu, gpu), the fastest first.

    A kind without measurements uses the candidates of CPUs: errors in float32 are similar, and costs have
    the same order.
    """
    classes = json.loads(FILE.read_text("utf-8"))["classes"]
    rows = classes.get(kind, classes["cpu"])["candidates"]
    return tuple(sorted((Candidate(**row) for row in rows), key=lambda candidate: candidate.cost))


@dataclass(frozen=True)
class Choice:
    """A chosen quality with its error, its frame time and their source."""

    quality: Quality
    error: float
    """largest absolute error of rgb: measured in the scene, or promised for a class of scenes"""
    ms: float | None
    """median frame time in milliseconds; None if not measured"""
    ms_p90: float | None
    """90th percentile of the frame time"""
    source: str
    """`promised`, `measured`, or `cached`: measured earlier and read from the user's cache folder"""
    device: str
    """name of the device"""
    settings: dict[str, Any]
    """settings that differ from `candidates.DEFAULTS`"""
    certified: float | None = None
    """largest value of the output `error`, if it was rendered (`certify`)"""
    remark: str = ""
    """class of scenes of a promise, or why there is no error bound"""

    def as_dict(self) -> dict[str, Any]:
        """All fields except the quality, for JSON."""
        return {name: value for name, value in vars(self).items() if name != "quality"}

    @property
    def summary(self) -> str:
        """Settings, error and frame time in one line of text."""
        settings = ", ".join(
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in ({"alpha_cutoff": self.quality.alpha_cutoff} | self.settings).items()
        )
        how = "promised error" if self.source == "promised" else "measured error"
        certified = "" if self.certified is None else f", certified at most {self.certified:.2g}"
        time = "" if self.ms is None else f", {self.ms:.3g} ms a frame"
        remark = f" ({self.remark})" if self.remark else ""
        return f"{settings}: {how} {self.error:.2g}{certified}{time} on {self.device}{remark}"
