"""Report of `fidsplat tradeoff report`: tables, charts and recommendations from results."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import pandas as pd

from fidsplat.experiments.charts import Axes, chart, label_points, literal, plain_ticks
from fidsplat.experiments.pages import NOTHING, fixed, number, page_and_folder, percent, write_page
from fidsplat.experiments.summary import Frame, Row, provenance
from fidsplat.experiments.tradeoff.points import ABLATION, COMBINED, MARKER, PRESET
from fidsplat.experiments.tradeoff.scenes import HARD, RANDOM, is_marker
from fidsplat.experiments.tradeoff.summary import TILT, DeviceResults, load
from fidsplat.util.errors import InputError

INVISIBLE = 1 / 512
"""half an 8-bit level"""
SMALLEST = 1e-7
"""lower limit of the error axis; smaller errors are plotted at this value"""
SHOWN_MARKER = "qr10"
"""marker of the table of mixtures"""
BASE, EXACT = ("base", "base"), (ABLATION, "exact")
"""setting and value of the baseline, and of the exact image"""
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
    page, folder = page_and_folder(out, "tradeoff.md.j2")
    devices, files = save_results(folders, folder)
    every = list(devices.values())
    repeated = {one.title for one, other in combinations(every, 2) if one.title == other.title}
    titles = {
        name: f"{device.title} ({name})" if device.title in repeated else device.title
        for name, device in devices.items()
    }
    refused = (row for device in every for row in device.refused.itertuples())
    context = {
        "devices": [
            {
                "name": name,
                "title": titles[name],
                "chart": folder / f"{name}.svg" in files,
                "settings": settings_table(device),
                "markers": markers_table(device),
            }
            for name, device in devices.items()
        ],
        "choices": recommendations(every),
        "refused": sorted({f"{row.knob} {row.value} ({row.error})" for row in refused}),
        "runs": provenance({titles[name]: device.summary for name, device in devices.items()}),
        "notes": [note for device in every for note in device.summary.notes],
        "marker": f"{SHOWN_MARKER} at {TILT} degrees",
    }
    write_page(page, folder, "tradeoff.md.j2", context)
    return [page, *files]


def save_results(folders: Sequence[Path], folder: Path) -> tuple[dict[str, DeviceResults], list[Path]]:
    """Write a table and a chart of each device into a folder; returns the results by file name (cpu, gpu,
    gpu-2 ...), and the files."""
    loaded = load(folders)
    names = _short_names(loaded)
    files = [folder / f"{name}.csv" for name in names]
    devices = {
        name: DeviceResults(device.summary.write(file))
        for name, device, file in zip(names, loaded, files, strict=True)
    }
    for name, device in devices.items():
        if scenes := disk_scenes(device):
            files.append(folder / f"{name}.svg")
            write_chart([device], scenes[0], files[-1])
    return devices, files


def write_plot(folders: Sequence[Path], file: Path) -> None:
    """Write one chart of results, with a panel for each device.

    Raises InputError when there are no results, the devices have no scene in common, or the file cannot be
    written.
    """
    devices = load(folders)
    first = devices[0]
    for scene in dict.fromkeys((*disk_scenes(first), *first.scenes)):
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
        error=points["maximum"].clip(lower=SMALLEST),
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


def settings_table(device: DeviceResults) -> Frame:
    """Time of each setting relative to the base, its largest error, and a verdict on the first scene that has
    it; for all scenes without markers."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for scene in (name for name in device.scenes if not is_marker(name)):
        for _, point in device.of(scene).iterrows():
            key = point["knob"], point["value"]
            row = rows.setdefault(
                key, {"setting": key[0], "value": key[1], "verdict": verdict(device, point)}
            )
            row[f"time, {scene}"] = percent(point["ratio"])
            row[f"largest error, {scene}"] = number(point["maximum"])
    return pd.DataFrame(rows.values()).fillna(NOTHING)


def verdict(device: DeviceResults, point: Row, base: tuple[str, str] | None = None) -> str:
    """Verdict on a setting relative to another one, by default to the base, or to the exact image if it is
    changed there; empty for another definition of the image."""
    base = base or (EXACT if point["knob"] == ABLATION else BASE)
    other = device.at(point["scene"], *base)
    if other is None or (point["knob"], point["value"]) == base or not device.is_comparable(point):
        return ""
    found = device.verdict(point, other)
    return "no effect" if found == "dominated" and point["maximum"] <= INVISIBLE / 2 else found


def markers_table(device: DeviceResults) -> Frame:
    """Time of marker qualities, without a low-pass with nine samples per pixel, and errors relative to the
    printed texture."""
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
                }
            )
    return pd.DataFrame(rows)


def recommendations(devices: Sequence[DeviceResults]) -> list[dict[str, str]]:
    """Cheapest setting with an invisible error on each device, for random scenes and for all scenes."""
    found = []
    for device in devices:
        every = disk_scenes(device)
        kind = "one's own scenes" if device.own else "random scenes"
        for text, scenes in ((kind, [s for s in every if s != HARD]), ("all scenes", every)):
            best = device.cheapest_within(scenes, INVISIBLE) if scenes else []
            if best:
                costs = ", ".join(f"{row['scene']} {percent(row['ratio'])}" for row in best)
                setting, value = best[0]["knob"], best[0]["value"]
                name = value if setting in ("base", PRESET, COMBINED) else f"{setting} {value}"
                found.append({"kind": device.kind, "on": text, "setting": name, "costs": costs})
    return found


def disk_scenes(device: DeviceResults) -> list[str]:
    """The user's scenes, random scenes of disks, the largest first, and the hard cases."""
    order = [*device.own, *reversed(RANDOM), HARD]
    return sorted((scene for scene in device.scenes if scene in order), key=order.index)


def _short_names(devices: Sequence[DeviceResults]) -> list[str]:
    """File names by kind: cpu, gpu, gpu-2 ..."""
    found: list[str] = []
    for device in devices:
        same = sum(name.partition("-")[0] == device.kind for name in found)
        found.append(device.kind if not same else f"{device.kind}-{same + 1}")
    return found
