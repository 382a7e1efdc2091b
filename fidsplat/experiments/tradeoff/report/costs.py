"""Tables: what each constant costs, and everything that was measured on a scene."""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING
from fidsplat.experiments.tradeoff.points import ALONE
from fidsplat.experiments.tradeoff.report.results import Measured, Results
from fidsplat.experiments.tradeoff.report.verdicts import noise, verdict
from fidsplat.experiments.tradeoff.report.wording import fixed, number, percent
from fidsplat.experiments.tradeoff.scenes import is_marker


@dataclass(frozen=True)
class Constant:
    """A constant of other systems, and what it is called among settings."""

    words: str
    value: str


CONSTANTS = (
    Constant("1/255: nothing fainter is drawn", "alpha_cutoff 1/255"),
    Constant("exp(-9/2): an opaque splat ends at 3 sigma, a fainter one sooner", "alpha_cutoff 3 sigma"),
    Constant("1e-4: a pixel is finished", "transmittance_stop 0.0001"),
    Constant("1/256: a pixel is finished", "transmittance_stop 1/256"),
    Constant("0.99: no fragment is more opaque", "opacity_ceiling 0.99"),
    Constant("exclusive stop at 1e-4: the last fragment is dropped", "stop_rule exclusive"),
    Constant("no low-pass, beside that of 2DGS", "lowpass none"),
    Constant("float32 set-up", "setup_precision float32"),
    Constant("our own exponentials and logarithms", "arithmetic fast"),
)
"""those of gsplat and of the 2DGS authors first"""


def report_constants(document: Document, results: Results) -> None:
    """The table of `CONSTANTS`, each alone in an exact picture: the time that it saves and the error that it
    makes, on scenes that are no markers."""
    scenes = [scene for scene in results.scenes if not is_marker(scene)]
    rows = []
    for constant in (Constant("none of these", "exact"), *CONSTANTS):
        row = [constant.words]
        for scene in scenes:
            having, without = (results.at(scene, ALONE, value) for value in (constant.value, "exact"))
            if having is None or without is None:
                row += [NOTHING] * 3
            else:
                row += [percent(having.ratio / without.ratio), *_errors(having)]
        if any(cell != NOTHING for cell in row[1:]):
            rows.append(row)
    heads = ["constant"]
    for scene in scenes:
        heads += [f"{scene}: time", "largest error", "RMSE"]
    if rows:
        document.table(heads, rows)


def report_knobs(document: Document, results: Results) -> None:
    """Each setting beside the base: time, largest error, RMSE on every scene that is no marker."""
    scenes = [scene for scene in results.scenes if not is_marker(scene)]
    rows = []
    for knob, value in results.settings():
        found = [results.at(scene, knob, value) for scene in scenes]
        if not any(found):
            continue
        row = [next(point.words for point in found if point is not None)]
        for point in found:
            row += [NOTHING] * 3 if point is None else _cells(point)
        rows.append(row)
    heads = ["setting"]
    for scene in scenes:
        heads += [f"{scene}: time", "largest", "RMSE"]
    document.table(heads, rows)


def _cells(point: Measured) -> list[str]:
    return [percent(point.ratio), *_errors(point)]


def _errors(point: Measured) -> list[str]:
    mark = "" if point.same_picture else " *"
    return [number(point.maximum) + mark, number(point.result["rmse"]) + mark]


def report_scene(document: Document, results: Results, scene: str) -> None:
    """Everything that was measured on one scene."""
    base, least = results.base(scene), noise(results, scene)
    rows = []
    for point in results.of(scene):
        found = point.result
        low, high = found["ratio_quartiles"]
        memory = found["memory_bytes"]
        rows.append(
            (
                point.words,
                fixed(found["ms"], 2),
                f"{point.ratio:.3f} ({low:.3f} to {high:.3f})",
                NOTHING if memory is None else f"{memory / 2**20:.1f}",
                number(found["maximum"]),
                number(found["maximum_sure"]),
                number(found["p999"]),
                number(found["rmse"]),
                fixed(found["psnr"]),
                number(found["flip"]),
                verdict(point, base, least) if point.same_picture else "another picture",
            )
        )
    heads = (
        "setting", "ms", "times the base (quartiles)", "MiB", "largest", "beyond certificates", "99.9 %",
        "RMSE", "PSNR", "FLIP", "verdict",
    )  # fmt: skip
    document.table(heads, rows)
    cells = base.result.get("cells")
    if cells:
        document.text("The largest error in each cell of the picture:")
        chosen = [point for point in results.of(scene) if "cells" in point.result]
        document.table(
            ("setting", *cells),
            [(point.words, *(number(point.result["cells"][name]) for name in cells)) for point in chosen],
        )
