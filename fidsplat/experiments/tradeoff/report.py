"""Report of `fidsplat tradeoff report`: tables, charts and recommendations from results."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from fidsplat.experiments.charts import Axes, chart, label_points, literal, plain_ticks
from fidsplat.experiments.pages import NOTHING, fixed, number, page_and_folder, percent, write_page
from fidsplat.experiments.summary import Frame, provenance
from fidsplat.experiments.tradeoff.points import ABLATION, COMBINED, MARKER, PRESET
from fidsplat.experiments.tradeoff.run import REFERENCE
from fidsplat.experiments.tradeoff.scenes import GAUSSIANS_3D, HARD, RANDOM
from fidsplat.experiments.tradeoff.summary import TILT, DeviceResults, load
from fidsplat.util.errors import InputError

INVISIBLE = 1 / 512
"""half an 8-bit level"""
_SMALLEST = 1e-7
"""lower limit of the error axis; smaller errors are plotted at this value"""
SHOWN_MARKER = "qr10"
"""marker of the table of mixtures"""


_EXACT = (ABLATION, "exact")
"""setting and value of the exact image"""


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
ELLIPSOIDS = {
    "ewa": "`ewa`: as 3DGS and gsplat",
    "ewa_antialiased": "`ewa_antialiased`: as Mip-Splatting",
    "exact": "`exact`",
}
"""projections of 3D Gaussians"""
_LABELS = {
    (PRESET, "gsplat"): "gsplat",
    (PRESET, "fast"): "fast",
    (PRESET, "standard"): "standard",
    (PRESET, "reference"): "reference",
    ("alpha_cutoff", "4/255"): "cut-off 4/255",
    ("alpha_cutoff", "1/1024"): "cut-off 1/1024",
    ("alpha_cutoff", "0.0001"): "cut-off 1e-4",
    (ABLATION, "opacity_ceiling 0.99"): "only alpha up to 0.99",
    (ABLATION, "transmittance_stop 1/256"): "only T down to 1/256",
    (ABLATION, "stop_rule exclusive"): "only the last fragment dropped",
}
"""labelled points of a chart"""


def write_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write the report, and for each device a chart and a table; returns the files, the report first.

    The tables suffice to make the same report again.

    Args:
        folders: folders with results, see `load`.
        out: folder for report.md and its files; or a name that ends in .md, whose files are written to a
            folder of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    page, folder = page_and_folder(out)
    context, files = report_content(folders, folder)
    write_page(page, folder, "accuracy.md.j2", context)
    return [page, *files]


def report_content(folders: Sequence[Path], folder: Path) -> tuple[dict[str, Any], list[Path]]:
    """Write the tables and charts of a report; returns the context of its template, and the files."""
    loaded = load(folders)
    names = _short_names(loaded)
    files = [folder / f"{name}.csv" for name in names]
    devices = [DeviceResults(device.summary.write(file)) for device, file in zip(loaded, files, strict=True)]
    shown = []
    for device, name in zip(devices, names, strict=True):
        scene = next(iter(_disk_scenes(device)), "")
        if scene:
            files.append(folder / f"{name}.svg")
            write_chart([device], scene, files[-1])
        facts = {"name": name, "kind": device.kind, "title": device.title, "scene": scene}
        shown.append(facts | {"facts": _facts(device)})
    repeated = {one.title for one, other in combinations(devices, 2) if one.title == other.title}
    titles = {
        f"{device.title} ({name})" if device.title in repeated else device.title: device.summary
        for device, name in zip(devices, names, strict=True)
    }
    disks = [device for device in devices if _disk_scenes(device)]
    return {
        "devices": shown,
        "constants": constants_table(disks) if disks else None,
        "ellipsoids": ellipsoids_table(devices),
        "orders": orders_table(devices),
        "markers": markers_table(devices[0]),
        "choices": recommendations(disks),
        "standard": max(_preset_error(device, "standard") for device in devices),
        "fast": max(_preset_error(device, "fast") for device in devices),
        "refused": sorted({f"{r.knob} {r.value} ({r.error})" for d in devices for r in _refused(d)}),
        "checked": max(_reference_error(device) for device in devices),
        "runs": provenance(titles),
        "notes": [note for device in devices for note in device.summary.notes],
        "marker": f"{SHOWN_MARKER} at {TILT} degrees",
        "invisible": INVISIBLE,
        "summary": False,
    }, files


def write_plot(folders: Sequence[Path], file: Path) -> None:
    """Write one chart of results, with a panel for each device.

    Raises InputError when there are no results, the devices have no scene in common, or the file cannot be
    written.
    """
    devices = load(folders)
    first = devices[0]
    for scene in dict.fromkeys((*_disk_scenes(first), *first.scenes)):
        if all(scene in device.scenes for device in devices):
            write_chart(devices, scene, file)
            return
    raise InputError(f"{' and '.join(device.title for device in devices)} have no scene in common to plot")


def write_chart(devices: Sequence[DeviceResults], scene: str, file: Path) -> None:
    """Write a chart of time and largest error of settings, with a panel for each device.

    Only settings with the image definition of the base are comparable.
    """
    with chart(file, len(devices), (9.0 * len(devices), 5.2)) as (figure, panels):
        labels = [_plot(axes, device, scene) for axes, device in zip(panels, devices, strict=True)]
        panels[0].set_ylabel("largest error (peak 1)")
        handles, texts = panels[0].get_legend_handles_labels()
        figure.legend(handles, texts, loc="outside lower center", ncols=4, frameon=False)
        for axes, points in zip(panels, labels, strict=True):
            label_points(figure, axes, points)


def _plot(axes: Axes, device: DeviceResults, scene: str) -> list[tuple[float, float, str]]:
    """Plot the settings of a device; returns labelled points."""
    points = device.same_definition(scene)
    points = points[points["value"] != "float64"]  # for reference images, and much slower
    points = points.assign(
        error=points["maximum"].clip(lower=_SMALLEST),
        label=[_LABELS.get(key) for key in zip(points["knob"], points["value"], strict=True)],
    )
    labelled = points[points["label"].notna()]
    cutoffs = points[points["knob"].isin(("base", "alpha_cutoff"))].sort_values("error")
    axes.set(xscale="log", yscale="log", xlabel="milliseconds per frame")
    axes.plot(points["ms"], points["error"], ".", color="#bbbbbb", label="every setting")
    axes.plot(cutoffs["ms"], cutoffs["error"], "-", color="#00798c", label="only the cut-off")
    for setting, style, colour, text in (
        (PRESET, "o", "#d1495b", "presets"),
        ("alpha_cutoff", "o", "#00798c", None),
        (ABLATION, "s", "#edae49", "one constant in an exact image"),
    ):
        chosen = labelled[labelled["knob"] == setting]
        axes.plot(chosen["ms"], chosen["error"], style, color=colour, label=text)
    axes.axhline(INVISIBLE, color="#777777", linestyle="--", linewidth=0.8)
    axes.annotate(
        "half an 8-bit level", (0, INVISIBLE), (4, 3), xycoords=("axes fraction", "data"),
        textcoords="offset points", fontsize=9, color="#555555",
    )  # fmt: skip
    axes.margins(0.08)
    plain_ticks(axes.xaxis)
    axes.set_title(literal(f"{scene} on {device.title}"))
    return list(labelled[["ms", "error", "label"]].itertuples(index=False, name=None))


def constants_table(devices: Sequence[DeviceResults]) -> Frame:
    """Time that each constant saves relative to the exact image, and its error; only measured constants."""
    rows = []
    shared = _shared_scene(devices)
    has_hard = any(HARD in device.scenes for device in devices)
    for constant in CONSTANTS:
        point = (constant.setting, constant.value)
        times, error = _compare(devices, shared, point, _EXACT)
        errors = {shared: error} | ({HARD: _compare(devices, HARD, point, _EXACT)[1]} if has_hard else {})
        if all(error is None for error in errors.values()):
            continue
        verdicts = [_verdict(device, constant) for device in devices]
        rows.append(
            {"constant": constant.text, "used by": constant.users}
            | ({} if shared == HARD else {f"time, {device.kind}": NOTHING for device in devices} | times)
            | {f"largest error, {scene}": number(error) for scene, error in errors.items()}
            | {"verdict": " / ".join(dict.fromkeys(filter(None, verdicts)))}
        )
    return pd.DataFrame(rows)


def _compare(
    devices: Sequence[DeviceResults], scene: str, setting: tuple[str, str], base: tuple[str, str]
) -> tuple[dict[str, str], float | None]:
    """Columns of the time of a setting relative to another, and its largest error; None if not measured."""
    times, errors = {}, []
    for device in devices:
        row, other = device.at(scene, *setting), device.at(scene, *base)
        if row is not None and other is not None:
            times[f"time, {device.kind}"] = percent(row["ratio"] / other["ratio"])
            errors.append(row["maximum"])
    return times, max(errors, default=None)


def _verdict(device: DeviceResults, constant: Constant) -> str:
    scene = _shared_scene([device])
    point, exact = device.at(scene, constant.setting, constant.value), device.at(scene, *_EXACT)
    if point is None or exact is None:
        return ""
    verdict = device.verdict(point, exact)
    return "no effect" if verdict == "dominated" and point["maximum"] <= INVISIBLE / 2 else verdict


def ellipsoids_table(devices: Sequence[DeviceResults]) -> Frame:
    """Time of each projection of 3D Gaussians relative to `ewa`, and its largest error."""
    rows = []
    for name, text in ELLIPSOIDS.items():
        row = {"3D Gaussians": text}
        for scene in GAUSSIANS_3D:
            times, error = _compare(devices, scene, ("ellipsoid", name), ("ellipsoid", "ewa"))
            if error is not None:
                row |= {time.replace("time", f"time, {scene}"): value for time, value in times.items()}
                row[f"largest error, {scene}"] = number(error)
        if len(row) > 1:
            rows.append(row)
    return pd.DataFrame(rows)


def orders_table(devices: Sequence[DeviceResults]) -> Frame:
    """Time of compositing by depth per pixel relative to the order of centres, and the errors of both.

    Errors are relative to the exact image in the same order.
    """
    rows, pixel, centre = [], ("order", "pixel"), ("order", "centre")
    for scene in dict.fromkeys(scene for device in devices for scene in device.scenes):
        times, error = _compare(devices, scene, pixel, centre)
        if times:
            errors = {"pixel": error, "centre": _compare(devices, scene, centre, pixel)[1]}
            columns = {f"largest error, `{name}`": number(error) for name, error in errors.items()}
            rows.append({"`pixel` relative to `centre`": scene} | columns | times)
    return pd.DataFrame(rows).fillna(NOTHING)


def markers_table(device: DeviceResults) -> Frame:
    """Marker qualities: time, PSNR relative to the printed texture, largest readable tilt.

    Rendered without a low-pass with nine samples per pixel.
    """
    view, rows = f"{SHOWN_MARKER}@{TILT}", []
    if view not in device.scenes:
        return pd.DataFrame()
    points = device.of(view)
    for _, point in points[points["knob"] == MARKER].iterrows():
        name, sharp, _ = point["value"].partition(", 3 x 3")
        if (sharp or name == "exact") and "growth" not in name:
            rows.append(
                {
                    "marker": name,
                    "Gaussians per rectangle": fixed(point["per_rectangle"], 0),
                    "time": percent(point["ratio"]),
                    "PSNR, dB": fixed(point["ideal_psnr"]),
                    "corner error, px": number(point["corners_px"]),
                    "read up to": fixed(device.read_to(SHOWN_MARKER, point["knob"], point["value"]), 0),
                }
            )
    return pd.DataFrame(rows)


def recommendations(devices: Sequence[DeviceResults]) -> list[dict[str, str]]:
    """Cheapest setting with an invisible error on each device, for random scenes and for all scenes."""
    found = []
    for device in devices:
        every = _disk_scenes(device)
        kind = "one's own scenes" if device.own else "random scenes"
        for text, scenes in ((kind, [s for s in every if s != HARD]), ("all scenes", every)):
            best = device.cheapest_within(scenes, INVISIBLE) if scenes else []
            if best:
                costs = ", ".join(f"{row['scene']} {percent(row['ratio'])}" for row in best)
                setting, value = best[0]["knob"], best[0]["value"]
                name = value if setting in ("base", PRESET, COMBINED) else f"{setting} {value}"
                found.append({"kind": device.kind, "on": text, "setting": name, "costs": costs})
    return found


def _facts(device: DeviceResults) -> dict[str, str]:
    """Comparison of `standard` with gsplat's constants on the plotted scene."""
    scene = _shared_scene([device])
    ours, theirs = (device.at(scene, PRESET, name) for name in ("standard", "gsplat"))
    if ours is None or theirs is None:
        return {}
    same = device.same_definition(scene)
    fastest = same[same["maximum"] <= theirs["maximum"]]["ratio"].min()
    most_accurate = same[same["ratio"] <= theirs["ratio"] * 1.02]["maximum"].min()
    return {
        "time": percent(ours["ratio"] / theirs["ratio"]),
        "better": f"{math.floor(theirs['maximum'] / max(ours['maximum'], _SMALLEST))}",
        "at_error": percent(fastest / theirs["ratio"]),
        "in_time": f"{math.floor(theirs['maximum'] / max(most_accurate, _SMALLEST))}",
        "noise": f"{device.noise(scene):.0%}",
    }


def _preset_error(device: DeviceResults, preset: str) -> float:
    """Largest error of a preset on scenes of disks."""
    points = [device.at(scene, PRESET, preset) for scene in _disk_scenes(device)]
    return max((point["maximum"] for point in points if point is not None), default=0.0)


def _disk_scenes(device: DeviceResults) -> list[str]:
    """The user's scenes, random scenes of disks, the largest first, and the hard cases."""
    order = [*device.own, *reversed(RANDOM), HARD]
    return sorted((s for s in device.scenes if s in order), key=order.index)


def _shared_scene(devices: Sequence[DeviceResults]) -> str:
    """First of the `_disk_scenes` that all devices have."""
    shared = (s for s in _disk_scenes(devices[0]) if all(s in device.scenes for device in devices))
    return next(shared, HARD)


def _refused(device: DeviceResults):
    rows = device.summary.rows
    return rows[rows["error"].notna()].itertuples()


def _reference_error(device: DeviceResults) -> float:
    """Largest error of reference images with order `centre`; with `pixel`, the order of ties is undefined."""
    rows = device.summary.rows
    checks = rows[(rows["what"] == REFERENCE) & ~rows["value"].str.endswith(", pixel", na=False)]
    worst = checks["maximum"].max()
    return 0.0 if pd.isna(worst) else float(worst)


def _short_names(devices: Sequence[DeviceResults]) -> list[str]:
    """File names by kind: cpu, gpu, gpu-2 ..."""
    found: list[str] = []
    for device in devices:
        same = sum(name.partition("-")[0] == device.kind for name in found)
        found.append(device.kind if not same else f"{device.kind}-{same + 1}")
    return found
