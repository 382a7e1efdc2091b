"""What numbers say of a setting: free, bought, a trap. The words of the report follow from here alone."""

from __future__ import annotations

import json
from collections.abc import Iterable

from fidsplat.experiments.tradeoff.report.results import Measured, Results

INVISIBLE = 1 / 512
"""half a step of 8 bits"""
TIME_CHANGES = 0.02
"""share by which the median must differ at least, besides both quartiles lying on that side"""
ERROR_CHANGES = 1.1
"""factor"""
_TINY = 1e-6
"""errors below this are rounding, and equal"""

FREE, BOUGHT, CHEAPER, TRAP, WASTE, FASTER, NOTHING, MIXED = (
    "free accuracy",
    "buys accuracy",
    "buys time",
    "trap",
    "waste",
    "free time",
    "no difference",
    "mixed",
)
MEANINGS = {
    FREE: "smaller error, no slower",
    FASTER: "faster, no larger error",
    BOUGHT: "smaller error, slower",
    CHEAPER: "faster, larger error",
    TRAP: "larger error, no faster",
    WASTE: "slower, no smaller error",
    NOTHING: "neither differs",
    MIXED: "one of largest error and RMSE falls and the other rises",
}
_BY_SIGNS = {
    (0, -1): FREE, (-1, -1): FREE, (1, -1): BOUGHT, (-1, 0): FASTER, (-1, 1): CHEAPER,
    (0, 1): TRAP, (1, 1): TRAP, (1, 0): WASTE, (0, 0): NOTHING,
}  # fmt: skip


def verdict(point: Measured, other: Measured, least: float, unit: float = 1.0) -> str:
    """What a setting is on a scene beside another of the same definition: the base, or one whose time is
    `unit` times the base's. least: the scene's `noise`."""
    signs = {_sign(point.result[name], other.result[name]) for name in ("maximum", "rmse")}
    if {-1, 1} <= signs:
        return MIXED
    return _BY_SIGNS[time_sign(point, least, unit), next((sign for sign in signs if sign), 0)]


def noise(results: Results, scene: str) -> float:
    """The share by which times differ on a scene for no reason: that of the base drawn beside itself, and
    that between settings that were measured twice, under two names."""
    shares = [abs(quartile - 1) for quartile in results.base(scene).result["ratio_quartiles"]]
    times: dict[str, list[float]] = {}
    for point in results.of(scene):
        times.setdefault(json.dumps(point.quality, sort_keys=True), []).append(point.ratio)
    return max(TIME_CHANGES, *shares, *(max(same) / min(same) - 1 for same in times.values()))


def time_sign(point: Measured, least: float, unit: float = 1.0) -> int:
    """-1 for a setting that is faster than the base (or `unit` times its time), 1 for a slower one, 0 where
    the noise `least` hides it."""
    low, high = (quartile / unit for quartile in point.result["ratio_quartiles"])
    if point.ratio / unit < 1 - least and high < 1:
        return -1
    return int(point.ratio / unit > 1 + least and low > 1)


def _sign(error: float, other: float) -> int:
    error, other = max(error, _TINY), max(other, _TINY)
    return int(error > other * ERROR_CHANGES) - int(error * ERROR_CHANGES < other)


def front(points: Iterable[Measured]) -> list[Measured]:
    """Those than which none is both as fast and as accurate, from fast to accurate."""
    found: list[Measured] = []
    for point in sorted(points, key=lambda p: (p.ratio, p.maximum)):
        if not found or point.maximum < found[-1].maximum:
            found.append(point)
    return found


def cheapest_within(results: Results, scenes: Iterable[str], bound: float) -> tuple[Measured, ...] | None:
    """The setting, measured on all the scenes, whose error is at most the bound on each apart from certified
    flips and whose product of costs (`Results.cost`) is least: what was measured of it, or None."""
    scenes = list(scenes)
    best: tuple[float, tuple[Measured, ...]] | None = None
    for knob, value in results.settings():
        found = [results.at(scene, knob, value) for scene in scenes]
        there = tuple(point for point in found if point is not None and point.same_picture)
        if len(there) < len(scenes) or not there or any(point.sure > bound for point in there):
            continue
        cost = 1.0
        for point in there:
            cost *= results.cost(point)
        if best is None or cost < best[0]:
            best = cost, there
    return None if best is None else best[1]
