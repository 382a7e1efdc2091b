"""Report of the results of `fidsplat tradeoff`: tables, charts and recommendations; see accuracy_page.py."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path

import pandas as pd

from fidsplat.experiments.pages import NOTHING, fill_template, fixed, number, percent
from fidsplat.experiments.summary import Row, Table, provenance
from fidsplat.experiments.tradeoff.plot import INVISIBLE, disk_scenes, write_chart
from fidsplat.experiments.tradeoff.points import ABLATION, COMBINED, MARKER, PRESET
from fidsplat.experiments.tradeoff.scenes import HARD, is_marker
from fidsplat.experiments.tradeoff.summary import TILT, DeviceResults, load
from fidsplat.util.files import printable, writable_folder, write_file

SHOWN_MARKER = "qr10"
"""marker of the table of mixtures"""
BASE, EXACT = ("base", "base"), (ABLATION, "exact")
"""setting and value of the baseline, and of the exact image"""
MIN_TIME_CHANGE = 0.02
"""minimum relative difference of times, in addition to both quartiles"""
MIN_ERROR_FACTOR = 1.1
"""minimum factor between errors that differ"""
_ROUNDING = 1e-6
"""errors below this are rounding"""
_VERDICTS = {
    (0, -1): "more accurate", (-1, -1): "more accurate", (1, -1): "slower, more accurate", (-1, 0): "faster",
    (-1, 1): "faster, less accurate", (0, 1): "dominated", (1, 1): "dominated", (1, 0): "slower",
    (0, 0): "no difference",
}  # fmt: skip
"""signs of the changes of time and error -> verdict"""


def write_report(folders: Sequence[Path], page: Path) -> list[Path]:
    """Write the report into FILE.md, and for each device a chart and a table into a folder of that name
    without .md; returns the files, the report first.

    The tables suffice to make the same report again. Raises InputError when there are no results.
    """
    folder = writable_folder(page.with_suffix(""))
    devices, files = save_results(folders, folder)
    every = list(devices.values())
    repeated = {one.title for one, other in combinations(every, 2) if one.title == other.title}
    titles = {
        name: f"{device.title} ({name})" if device.title in repeated else device.title
        for name, device in devices.items()
    }
    rows = [device.summary.rows for device in every]
    refused = (row for own in rows for row in own[own["error"].notna()].itertuples())
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
        "refused": sorted({f"{row.setting} {row.value} ({row.error})" for row in refused}),
        "runs": provenance({titles[name]: device.summary for name, device in devices.items()}),
        "notes": [note for device in every for note in device.summary.notes],
        "marker": f"{SHOWN_MARKER} at {TILT} degrees",
    }
    write_file(page, printable(fill_template(page, folder, "tradeoff.md.j2", context, Path(__file__).parent)))
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


def settings_table(device: DeviceResults) -> Table:
    """Time of each setting relative to the base, its largest error, and a verdict on the first scene that has
    it; for all scenes without markers."""
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for scene in (name for name in device.scenes if not is_marker(name)):
        for _, point in device.of(scene).iterrows():
            key = point["setting"], point["value"]
            row = rows.setdefault(
                key, {"setting": key[0], "value": key[1], "verdict": verdict(device, point)}
            )
            row[f"time, {scene}"] = percent(point["ratio"])
            row[f"largest error, {scene}"] = number(point["maximum"])
    return pd.DataFrame(rows.values()).fillna(NOTHING)


def verdict(device: DeviceResults, point: Row, base: tuple[str, str] | None = None) -> str:
    """Verdict on a setting relative to another one, by default to the base, or to the exact image if it is
    changed there; empty for another definition of the image."""
    base = base or (EXACT if point["setting"] == ABLATION else BASE)
    other = device.at(point["scene"], *base)
    if (
        other is None
        or (point["setting"], point["value"]) == base
        or point.name not in device.same_definition(point["scene"]).index
    ):
        return ""
    found = compared(device, point, other)
    return "no effect" if found == "dominated" and point["maximum"] <= INVISIBLE / 2 else found


def markers_table(device: DeviceResults) -> Table:
    """Time of marker qualities, without a low-pass with nine samples per pixel, and errors relative to the
    printed texture."""
    view, rows = f"{SHOWN_MARKER}@{TILT}", []
    if view not in device.scenes:
        return pd.DataFrame()
    points = device.of(view)
    for _, point in points[points["setting"] == MARKER].iterrows():
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
    """Fastest setting with an invisible error on each device, for random scenes and for all scenes."""
    found = []
    for device in devices:
        every = disk_scenes(device)
        kind = "one's own scenes" if device.own else "random scenes"
        for text, scenes in ((kind, [s for s in every if s != HARD]), ("all scenes", every)):
            best = cheapest_within(device, scenes, INVISIBLE) if scenes else []
            if best:
                costs = ", ".join(f"{row['scene']} {percent(row['ratio'])}" for row in best)
                setting, value = best[0]["setting"], best[0]["value"]
                name = value if setting in ("base", PRESET, COMBINED) else f"{setting} {value}"
                found.append({"kind": device.kind, "on": text, "setting": name, "costs": costs})
    return found


def noise_of(device: DeviceResults, scene: str) -> float:
    """Noise of times as a relative difference.

    Measured on the base relative to itself, and on qualities with two names.
    """
    base = device.points.loc[(scene, "base", "base")]
    ratios = device.of(scene).groupby("quality")["ratio"]
    repeated = (ratios.max() / ratios.min() - 1).max()
    return max(MIN_TIME_CHANGE, abs(base["ratio_low"] - 1), abs(base["ratio_high"] - 1), repeated)


def cost(device: DeviceResults, point: Row) -> float:
    """Time of a setting relative to the base, comparable between settings.

    The host of a GPU delays both frames of a pair equally, so there the difference is divided by the
    median of the base.
    """
    if device.kind != "gpu":
        return point["ratio"]
    return 1 + (point["ratio"] - 1) * point["base_ms"] / device.base_ms(point["scene"])


def compared(device: DeviceResults, point: Row, other: Row) -> str:
    """Verdict on a setting relative to another with the same low-pass, samples and order."""
    errors = {_sign(point[name], other[name]) for name in ("maximum", "rmse")}
    if {-1, 1} <= errors:
        return "mixed"
    unit, noise = other["ratio"], noise_of(device, point["scene"])
    faster = point["ratio"] / unit < 1 - noise and point["ratio_high"] < unit
    slower = point["ratio"] / unit > 1 + noise and point["ratio_low"] > unit
    return _VERDICTS[int(slower) - int(faster), sum(errors)]


def cheapest_within(device: DeviceResults, scenes: Iterable[str], bound: float) -> list[Row]:
    """Rows of the fastest setting with errors of at most a bound on all scenes; [] if there is none.

    Settings are compared by the product of their times; errors within error bounds do not count.
    """
    scenes = list(scenes)
    rows: Table = pd.concat([device.same_definition(scene) for scene in scenes])
    best: tuple[float, list[Row]] = (math.inf, [])
    for _, found in rows.groupby(["setting", "value"], sort=False):
        error = found["beyond"].fillna(found["maximum"]).max()
        own = [row for _, row in found.iterrows()]
        product = math.prod(cost(device, row) for row in own)
        if len(own) == len(scenes) and error <= bound and product < best[0]:
            best = product, own
    return best[1]


def _sign(error: float, other: float) -> int:
    error, other = max(error, _ROUNDING), max(other, _ROUNDING)
    return int(error > other * MIN_ERROR_FACTOR) - int(error * MIN_ERROR_FACTOR < other)


def _short_names(devices: Sequence[DeviceResults]) -> list[str]:
    """File names by kind: cpu, gpu, gpu-2 ..."""
    found: list[str] = []
    for device in devices:
        same = sum(name.partition("-")[0] == device.kind for name in found)
        found.append(device.kind if not same else f"{device.kind}-{same + 1}")
    return found
