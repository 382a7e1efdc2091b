"""Write the measurements of docs/accuracy.md from results of `fidsplat tradeoff`.

    python benchmarks/accuracy_page.py [DIR ...]

DIR: folders with results or their tables; by default devlog/accuracy. Replaces the generated block of
docs/accuracy.md, and writes devlog/accuracy.md, the report of `fidsplat tradeoff report`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from fidsplat.experiments.pages import NOTHING, fill_template, number, percent
from fidsplat.experiments.summary import Frame
from fidsplat.experiments.tradeoff.points import ABLATION, PRESET
from fidsplat.experiments.tradeoff.report import (
    EXACT,
    disk_scenes,
    verdict,
    write_report,
)
from fidsplat.experiments.tradeoff.scenes import HARD
from fidsplat.experiments.tradeoff.summary import DeviceResults, load
from fidsplat.util.files import write_file

TREE = Path(__file__).parents[1]
PAGE, REPORT = TREE / "docs" / "accuracy.md", TREE / "devlog" / "accuracy.md"
SCENE = "r1m_1080p"
BEGIN, END = "<!-- begin generated -->\n", "<!-- end generated -->\n"


class Constant(NamedTuple):
    """A constant of splat renderers, and the point that measures it."""

    text: str
    users: str
    setting: str
    value: str


CONSTANTS = (
    Constant("alpha below 1/255 is skipped", "3DGS, 2DGS, gsplat", ABLATION, "alpha_cutoff 1/255"),
    Constant(
        "splats are truncated at 3 sigma", "3DGS, 2DGS (bounding boxes)", ABLATION, "alpha_cutoff 3 sigma"
    ),
    Constant("blending stops at T = 1e-4", "our `standard`", ABLATION, "transmittance_stop 0.0001"),
    Constant("blending stops at T = 1/256", "our `fast`", ABLATION, "transmittance_stop 1/256"),
    Constant("stop at 1e-4 without the last fragment", "3DGS, 2DGS, gsplat", ABLATION, "stop_rule exclusive"),
    Constant("alpha is clamped to 0.99", "3DGS, 2DGS, gsplat", ABLATION, "opacity_ceiling 0.99"),
    Constant("projection in float32", "3DGS, 2DGS, gsplat, our `fast`", ABLATION, "setup_precision float32"),
    Constant("exponentials by polynomials", "our `standard`, `fast`", ABLATION, "arithmetic fast"),
    Constant("exponentials by GPU instructions", "3DGS, gsplat, HiGS", ABLATION, "arithmetic approximate"),
    Constant("colours and transmittance in float16", "HiGS", ABLATION, "blend_precision float16"),
    Constant("**`gsplat`**: gsplat's constants together", "gsplat, 2DGS", PRESET, "gsplat"),
    Constant("**`fast`**: 2/255, T = 1/256, float32 set-up", "ours", PRESET, "fast"),
    Constant("**`standard`**: 1e-5, T = 1e-4, exponentials", "ours", PRESET, "standard"),
)


def write_accuracy(folders: Sequence[Path], page: Path = PAGE, report: Path = REPORT) -> None:
    """Write the block of a page, and a report with its tables and charts in the folder of its name."""
    folder = report.with_suffix("")
    write_report(folders, report)
    devices = [device for device in load([folder]) if SCENE in device.scenes]
    errors = {
        name: max(
            device.at(scene, PRESET, name)["maximum"] for device in devices for scene in disk_scenes(device)
        )
        for name in ("standard", "fast")
    }
    context = {
        "scene": SCENE,
        "facts": {device.title: facts_of(device) for device in devices},
        "constants": constants_table(devices),
    }
    before, _, rest = page.read_text("utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    block = fill_template(page, folder, "accuracy.md.j2", context | errors, Path(__file__).parent)
    write_file(page, f"{before}{BEGIN}{block}{END}{after}")


def constants_table(devices: Sequence[DeviceResults]) -> Frame:
    """Time that each constant saves relative to the exact image, its largest error, and verdicts."""
    rows = []
    for constant in CONSTANTS:
        row: dict[str, str] = {"constant": constant.text, "used by": constant.users}
        errors: dict[str, list[float]] = {SCENE: [], HARD: []}
        verdicts = []
        for device in devices:
            row[f"time, {device.kind}"] = NOTHING
            for scene in errors:
                point = device.at(scene, constant.setting, constant.value)
                if point is not None:
                    errors[scene].append(point["maximum"])
            point, exact = (device.at(SCENE, *key) for key in (constant[2:], EXACT))
            if point is not None:
                row[f"time, {device.kind}"] = percent(point["ratio"] / exact["ratio"])
                verdicts.append(verdict(device, point, EXACT))
        row |= {f"largest error, {scene}": number(max(found)) for scene, found in errors.items() if found}
        if verdicts:
            rows.append(row | {"verdict": " / ".join(dict.fromkeys(verdicts))})
    return pd.DataFrame(rows)


def facts_of(device: DeviceResults) -> dict[str, str]:
    """Comparison of `standard` with gsplat's constants."""
    ours, theirs = (device.at(SCENE, PRESET, name) for name in ("standard", "gsplat"))
    same = device.same_definition(SCENE)
    fastest = same[same["maximum"] <= theirs["maximum"]]["ratio"].min()
    most_accurate = same[same["ratio"] <= theirs["ratio"] * 1.02]["maximum"].min()
    return {
        "time": percent(ours["ratio"] / theirs["ratio"]),
        "better": f"{math.floor(theirs['maximum'] / ours['maximum'])}",
        "at_error": percent(fastest / theirs["ratio"]),
        "in_time": f"{math.floor(theirs['maximum'] / most_accurate)}",
    }


if __name__ == "__main__":
    write_accuracy([Path(name) for name in sys.argv[1:]] or [REPORT.with_suffix("")])
