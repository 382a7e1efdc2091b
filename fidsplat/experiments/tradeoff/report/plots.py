"""Plots: time against error, and Gaussians per rectangle against what markers are worth."""

from __future__ import annotations

from collections.abc import Iterator

from fidsplat.experiments.scatter import Axis, Dot, scatter_chart
from fidsplat.experiments.tradeoff.points import ALONE, MARKER_KNOB, PRESETS_KNOB, TOGETHER
from fidsplat.experiments.tradeoff.report.results import Measured, Results
from fidsplat.experiments.tradeoff.report.verdicts import front
from fidsplat.experiments.tradeoff.scenes import MARKERS, is_marker

_LEAST = 1e-7
"""errors below this are drawn there"""
PLOTTED_TILT = 60
"""degrees at which markers are plotted"""
_SERIES = {
    "base": "base",
    PRESETS_KNOB: "preset",
    ALONE: "a constant in the exact picture",
    "alpha_cutoff": "alpha_cutoff",
    "transmittance_stop": "transmittance_stop",
    MARKER_KNOB: "marker",
    TOGETHER: "several knobs",
}
_REST = "another knob"
"""knobs that have a colour of their own, as there are not enough for all, and what the others are called"""


def pareto_chart(results: Results, scene: str) -> str:
    """Milliseconds against the largest error of every setting with the base's definition; for a marker
    against the RMSE from the ideal texture, of every setting."""
    ms = results.base_ms(scene)
    marked = is_marker(scene)
    points = [point for point in results.of(scene) if marked or point.same_picture]
    best = {id(point) for point in front(points)} if not marked else set()
    series: dict[str, list[Dot]] = {}
    for point in points:
        named = point.knob in ("base", PRESETS_KNOB) or id(point) in best or point.knob == MARKER_KNOB
        dot = Dot(ms * point.ratio, _error(point, marked), point.words if named else "")
        series.setdefault(_SERIES.get(point.knob, _REST), []).append(dot)
    line = [Dot(ms * point.ratio, _error(point, False)) for point in front(points)] if not marked else []
    error = "RMSE from the ideal texture" if marked else "largest error against float64"
    return scatter_chart(
        f"{scene} on {results.title}", Axis("ms per frame", True), Axis(error, True), series, line
    )


def _error(point: Measured, marked: bool) -> float:
    if not marked:
        return max(point.maximum, _LEAST)
    decibels = point.result["ideal_psnr"]
    return _LEAST if decibels is None else max(10 ** (-decibels / 20), _LEAST)


def marker_charts(results: Results) -> Iterator[tuple[str, str, str]]:
    """Gaussians per rectangle against PSNR from the ideal texture, and against the largest tilt that is
    read: (name, title, SVG) of each."""
    decibels: dict[str, list[Dot]] = {}
    tilts: dict[str, list[Dot]] = {}
    for name in MARKERS:
        scene = f"{name}@{PLOTTED_TILT}"
        for point in results.of(scene):
            if point.knob not in ("base", MARKER_KNOB):
                continue
            each = point.result["splats"] / point.result["rectangles"]
            if point.result["ideal_psnr"] is not None:
                label = point.words if name == "qr10" else ""
                decibels.setdefault(name, []).append(Dot(each, point.result["ideal_psnr"], label))
            angle = results.angle(name, point.knob, point.value)
            if angle is not None:
                tilts.setdefault(name, []).append(Dot(each, angle, point.words if name == "qr10" else ""))
    across = Axis("Gaussians per rectangle", True)
    if decibels:
        title = f"PSNR from the ideal texture at {PLOTTED_TILT} degrees, {results.title}"
        yield "psnr", title, scatter_chart(title, across, Axis("dB"), decibels)
    if tilts:
        title = f"Tilt up to which a marker is read, {results.title}"
        yield "angle", title, scatter_chart(title, across, Axis("degrees"), tilts)
