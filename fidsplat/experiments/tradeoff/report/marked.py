"""Tables of markers: what Gaussians give, and what the other constants do to them."""

from __future__ import annotations

from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING
from fidsplat.experiments.tradeoff.points import MARKER_KNOB, PRESETS_KNOB
from fidsplat.experiments.tradeoff.report.results import Measured, Results
from fidsplat.experiments.tradeoff.report.wording import fixed, number, percent
from fidsplat.experiments.tradeoff.scenes import MARKERS, views_of


def report_marker(document: Document, results: Results, name: str) -> None:
    """One marker: every setting's time, PSNR from the ideal and corner errors at the tilts, and how far it
    is read."""
    views = [view for view in views_of(name) if view in results.scenes]
    ceiling = results.ceiling(name)
    document.text(
        f"The ideal texture is read up to {fixed(ceiling, 0)} degrees."
        if ceiling is not None
        else "The ideal texture was not tilted."
    )
    rows = []
    for knob, value in results.settings():
        found = [results.at(view, knob, value) for view in views]
        there = [point for point in found if point is not None]
        if not there:
            continue
        angle = results.angle(name, knob, value)
        each = there[0].result["splats"] / there[0].result["rectangles"]
        row = [there[0].words, fixed(each) if knob in ("base", PRESETS_KNOB, MARKER_KNOB) else ""]
        row += [_joined(found, lambda p: percent(p.ratio)), _joined(found, _decibels)]
        row += [_joined(found, lambda p: number(p.result["corners_px"]))]
        row += [_joined(found, lambda p: number(p.maximum)), fixed(angle, 0)]
        rows.append(row)
    tilts = " / ".join(view.partition("@")[2] for view in views)
    heads = (
        "setting", "Gaussians per rectangle", f"time at {tilts}", "PSNR from the ideal, dB",
        "corner error, px", "largest error from its own definition", "read up to",
    )  # fmt: skip
    document.table(heads, rows)


def marker_names(results: Results) -> list[str]:
    """Markers of which there are results."""
    return [name for name in MARKERS if any(view in results.scenes for view in views_of(name))]


def _joined(found: list[Measured | None], words) -> str:
    return " / ".join(NOTHING if point is None else words(point) for point in found)


def _decibels(point: Measured) -> str:
    return fixed(point.result["ideal_psnr"])
