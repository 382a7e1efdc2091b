"""Write the measurements of docs/accuracy.md from results of `fidsplat tradeoff`.

    python benchmarks/accuracy_page.py [DIR ...]

DIR: folders with results of `fidsplat tradeoff` or their tables; by default devlog/accuracy. Replaces the
generated block of docs/accuracy.md, with a chart for each device of benchmarks/results/suite-*.json, and
writes devlog/accuracy.md, with tables and charts in the folder devlog/accuracy.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import splatmark
from tradeoff_report import EXACT, verdict, write_report

from fidsplat.experiments.charts import chart, label_points, literal, plain_ticks
from fidsplat.experiments.pages import NOTHING, fill_template, number, percent
from fidsplat.experiments.summary import Table
from fidsplat.experiments.tradeoff.plot import disk_scenes
from fidsplat.experiments.tradeoff.points import ABLATION, PRESET
from fidsplat.experiments.tradeoff.scenes import HARD
from fidsplat.experiments.tradeoff.summary import DeviceResults, load
from fidsplat.util.files import write_file

TREE = Path(__file__).parents[1]
PAGE, REPORT = TREE / "docs" / "accuracy.md", TREE / "devlog" / "accuracy.md"
SCENE = "r1m_1080p"
SUITES = sorted((TREE / "benchmarks" / "results").glob("suite-*.json"))
SHOWN = {"r100k_720p": "disks", "biker_720p": "3D Gaussians"}
"""scenes of the charts of the suite"""
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
    Constant(
        "projection in float32", "3DGS, 2DGS, gsplat, our `fast`", ABLATION, "projection_precision float32"
    ),
    Constant("exponentials by polynomials", "our `standard`, `fast`", ABLATION, "arithmetic fast"),
    Constant("exponentials by GPU instructions", "3DGS, gsplat, HiGS", ABLATION, "arithmetic approximate"),
    Constant("colours and transmittance in float16", "HiGS", ABLATION, "blend_precision float16"),
    Constant("**`gsplat`**: gsplat's constants together", "gsplat, 2DGS", PRESET, "gsplat"),
    Constant("**`fast`**: 2/255, T = 1/256, float32 projection", "ours", PRESET, "fast"),
    Constant("**`standard`**: 1e-5, T = 1e-4, exponentials", "ours", PRESET, "standard"),
)


def write_accuracy(folders: Sequence[Path], page: Path = PAGE, report: Path = REPORT) -> None:
    """Write the generated block of a page, and a report with tables and charts in the folder of its name."""
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
        "facts": [suite_facts(device, folder) for device in splatmark.load(SUITES)],
        "constants": constants_table(devices),
    }
    before, _, rest = page.read_text("utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    block = fill_template(page, folder, "accuracy.md.j2", context | errors, Path(__file__).parent)
    write_file(page, f"{before}{BEGIN}{block}{END}{after}")


def constants_table(devices: Sequence[DeviceResults]) -> Table:
    """Table of constants: time saved relative to the exact image, largest error, and verdicts."""
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


def suite_facts(device: splatmark.Device, folder: Path) -> dict[str, str]:
    """Chart of a device, and comparison of `standard` with gsplat's constants."""
    scene = next(iter(SHOWN))
    settings = {one["setting"]: one for one in device.results[::-1] if one["scene"] == scene}
    ours, theirs = settings["standard"], settings["gsplat"]
    file = folder / f"{device.name.replace(' ', '-')}.svg"
    write_chart(device, file)
    return {
        "title": device.title,
        "chart": file.name,
        "scene": scene,
        "better": f"{theirs['largest_error'] / ours['largest_error']:.0f}",
        "time": percent(ours["quartiles_ms"][1] / theirs["quartiles_ms"][1]),
    }


def write_chart(device: splatmark.Device, file: Path) -> None:
    """Write a chart of time and largest error of all renderers and settings, with a panel for each scene."""
    renderers = list(dict.fromkeys(one["renderer"] for one in device.results))
    with chart(file, len(SHOWN), (11.0, 4.6)) as (figure, panels):
        points = []
        for axes, scene in zip(panels, SHOWN, strict=True):
            found = [one for one in device.results if one["scene"] == scene]
            labels = []
            for one in found:
                at, name = (one["quartiles_ms"][1], one["largest_error"]), one["renderer"]
                color = splatmark.COLORS[renderers.index(name) % len(splatmark.COLORS)]
                axes.plot(*at, "o", color=color, label=literal(name))
                labels.append((*at, one["setting"] if name.startswith("fidsplat") else name))
            points.append(labels)
            axes.set(xscale="log", yscale="log", xlabel="milliseconds per frame")
            axes.axhline(splatmark.LIMIT, color="#777777", linestyle="--", linewidth=0.8)
            axes.margins(0.1)
            plain_ticks(axes.xaxis)
            axes.set_title(f"{scene}: {SHOWN[scene]}")
        panels[0].set_ylabel("largest error; dashed: 1/255")
        entries = {
            name: handle
            for axes in panels
            for handle, name in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(entries.values(), entries, loc="outside lower center", ncols=4, frameon=False)
        for axes, labels in zip(panels, points, strict=True):
            label_points(figure, axes, labels)


if __name__ == "__main__":
    write_accuracy([Path(name) for name in sys.argv[1:]] or [REPORT.with_suffix("")])
