"""The price list: the candidates that a budget chooses among, with what each was measured to give
(prices.json, made by benchmarks/budget_prices.py)."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from fidsplat.capture.quality import Quality

FILE = Path(__file__).with_name("prices.json")
MARGIN = 1.5
"""how many times below the bound the largest error of a candidate over the list's scenes must lie: that over
other scenes is a little larger"""

FREE: dict[str, Any] = {
    "alpha_cutoff": 1.0 / 255.0,
    "transmittance_stop": 1e-4,
    "setup_precision": "float64",
    "arithmetic": "precise",
    "blend_precision": "float32",
}
"""The knobs that a budget turns, and where they stand unless a candidate says otherwise. Of the other knobs
those that only make a picture wrong are off (opacity ceiling, exclusive stop); the rest are its definition
and stay as the base quality has them."""
COMMON = ("alpha_cutoff", "transmittance_stop", "arithmetic")
"""those of them that every device has"""


@dataclass(frozen=True)
class Candidate:
    """One choice of the knobs, and what it was measured to give."""

    knobs: dict[str, Any]
    """those of `FREE` that differ from it"""
    easy: float
    """the largest error of a picture, in the easiest twentieth of the list's scenes"""
    median: float
    """the same, in the median scene"""
    most: float
    """and in the hardest"""
    cost: float
    """time of a frame, in that of the candidate without any knobs (on CPUs the processor's time)"""

    def of(self, base: Quality) -> Quality:
        """The quality with the definition of `base` and the accuracy of this candidate."""
        return base.with_(**(FREE | {"opacity_ceiling": 1.0, "stop_rule": "inclusive"} | self.knobs))

    @property
    def everywhere(self) -> Candidate:
        """What is drawn instead where a device lacks its other knobs: those that all have, no less accurate
        but for float64 blending."""
        common = {name: value for name, value in self.knobs.items() if name in COMMON}
        return replace(self, knobs=common)

    @property
    def promised(self) -> float:
        """The error that is expected in a scene like those of the list: no bound, as its fragments may be
        fainter, more, brighter and thinner."""
        return MARGIN * self.most


@cache
def load(kind: str) -> tuple[Candidate, ...]:
    """The candidates for a kind of device (cpu, gpu), the cheapest first.

    A kind for which nothing has been measured has the candidates of CPUs: the errors are those of float32
    everywhere, and costs rank alike.
    """
    classes = json.loads(FILE.read_text("utf-8"))["classes"]
    rows = classes.get(kind, classes["cpu"])["candidates"]
    return tuple(sorted((Candidate(**row) for row in rows), key=lambda candidate: candidate.cost))
