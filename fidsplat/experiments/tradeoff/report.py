"""The page of `fidsplat tradeoff report`: its tables and charts, worked out from results alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from fidsplat.experiments.charts import Axes, chart, label_points, literal, plain_ticks
from fidsplat.experiments.pages import fixed, has_block, number, percent, places, write_block, write_page
from fidsplat.experiments.summary import Frame, Row, provenance
from fidsplat.experiments.tradeoff.linear import ANGLES, DISTANCES
from fidsplat.experiments.tradeoff.points import ALONE, MARKER_KNOB, PRESETS_KNOB, TOGETHER
from fidsplat.experiments.tradeoff.run import LINEAR
from fidsplat.experiments.tradeoff.scenes import HARD, RANDOM, THICK
from fidsplat.experiments.tradeoff.summary import TILT, Device, load
from fidsplat.util.errors import InputError

INVISIBLE = 1 / 512
"""half a step of 8 bits"""
_LEAST = 1e-7
"""errors below this are drawn there"""
MARKER = "qr10"
"""the marker that the table of mixtures shows"""
_SHARP = ", 3 x 3"
"""ends the name of a marker that is drawn without a low-pass and with nine samples a pixel"""


class Constant(NamedTuple):
    """A constant of splat renderers, and the point that measures it."""

    words: str
    users: str
    knob: str
    value: str


CONSTANTS = (
    Constant("alpha below 1/255 is skipped", "3DGS, 2DGS, gsplat", ALONE, "alpha_cutoff 1/255"),
    Constant("splats are truncated at 3 sigma", "3DGS, 2DGS (bounding boxes)", ALONE, "alpha_cutoff 3 sigma"),
    Constant("blending stops at T = 1e-4", "our `standard`", ALONE, "transmittance_stop 0.0001"),
    Constant("blending stops at T = 1/256", "our `fast`", ALONE, "transmittance_stop 1/256"),
    Constant("stop at 1e-4 without the last fragment", "3DGS, 2DGS, gsplat", ALONE, "stop_rule exclusive"),
    Constant("alpha is clamped to 0.99", "3DGS, 2DGS, gsplat", ALONE, "opacity_ceiling 0.99"),
    Constant("projection in float32", "3DGS, 2DGS, gsplat, our `fast`", ALONE, "setup_precision float32"),
    Constant("exponentials by polynomials", "our `standard`, `fast`", ALONE, "arithmetic fast"),
    Constant("**`gsplat`**: gsplat's constants together", "gsplat, 2DGS", PRESETS_KNOB, "gsplat"),
    Constant("**`fast`**: 2/255, T = 1/256, float32 set-up", "ours", PRESETS_KNOB, "fast"),
    Constant("**`standard`**: 1e-5, T = 1e-4, exponentials", "ours", PRESETS_KNOB, "standard"),
)
WAYS = {
    "ewa": "`ewa`: as 3DGS and gsplat",
    "ewa_antialiased": "`ewa_antialiased`: as Mip-Splatting",
    "exact": "`exact`",
}
"""ways of drawing 3D Gaussians"""
_LABELLED = {
    (PRESETS_KNOB, "gsplat"): "gsplat",
    (PRESETS_KNOB, "fast"): "fast",
    (PRESETS_KNOB, "standard"): "standard",
    (PRESETS_KNOB, "reference"): "reference",
    ("alpha_cutoff", "4/255"): "cut-off 4/255",
    ("alpha_cutoff", "1/1024"): "cut-off 1/1024",
    ("alpha_cutoff", "0.0001"): "cut-off 1e-4",
    (ALONE, "opacity_ceiling 0.99"): "only alpha up to 0.99",
    (ALONE, "transmittance_stop 1/256"): "only T down to 1/256",
    (ALONE, "stop_rule exclusive"): "only the last fragment dropped",
}
"""the points of a chart that have names"""


def write_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write the page, and for each device a chart and its results as a table; returns the files, the page
    first. From the folder of those tables the same page can be made again.

    A page that exists with a generated block (`pages.BEGIN`) keeps its text: the block is replaced by a
    summary, and the complete report is written as report.md next to the tables.

    Args:
        folders: where results lie, see `load`.
        out: a folder for report.md and all that belongs to it; or a name that ends in .md, and the rest goes
            into a folder of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    page, folder = places(out)
    loaded = load(folders)
    names = _short_names(loaded)
    files = [folder / f"{name}.csv" for name in names]
    devices = [Device(device.summary.write(file)) for device, file in zip(loaded, files, strict=True)]
    plotted = [next(iter(_plain(device)), "") for device in devices]
    plain = [device for device in devices if _plain(device)]
    twice = {device.title for device, other in combinations(devices, 2) if device.title == other.title}
    for device, name, scene in zip(devices, names, plotted, strict=True):
        if scene:
            files.append(folder / f"{name}.svg")
            draw_chart([device], scene, files[-1])
    context = {
        "devices": [
            {
                "name": name,
                "kind": device.kind,
                "title": device.title,
                "scene": scene,
                "facts": _facts(device),
            }
            for device, name, scene in zip(devices, names, plotted, strict=True)
        ],
        "constants": constants_table(plain) if plain else None,
        "ways": ways_table(devices),
        "linear": linear_table(devices),
        "orders": orders_table(devices),
        "markers": markers_table(devices[0]),
        "choices": choices(plain),
        "standard": max((_worst(device, "standard") for device in devices), default=0.0),
        "fast": max((_worst(device, "fast") for device in devices), default=0.0),
        "refused": sorted({f"{r.knob} {r.value} ({r.error})" for d in devices for r in _refused(d)}),
        "checked": max((_truth_error(device) for device in devices), default=0.0),
        "runs": provenance(
            {
                f"{device.title} ({name})" if device.title in twice else device.title: device.summary
                for device, name in zip(devices, names, strict=True)
            }
        ),
        "notes": [note for device in devices for note in device.summary.notes],
        "marker": f"{MARKER} at {TILT} degrees",
        "invisible": INVISIBLE,
    }
    if not has_block(page):
        write_page(page, folder, "accuracy.md.j2", context | {"summary": False})
        return [page, *files]
    write_block(page, folder, "accuracy_summary.md.j2", context | {"summary": True})
    complete = folder / "report.md"
    write_page(complete, folder, "accuracy.md.j2", context | {"summary": False})
    return [page, complete, *files]


def write_plot(folders: Sequence[Path], file: Path) -> None:
    """One chart of the results in folders, a panel for each device.

    Raises InputError when there are no results, no scene that all devices have drawn, or the file cannot be
    written.
    """
    devices = load(folders)
    draw_chart(devices, plotted_scene(devices), file)


def plotted_scene(devices: Sequence[Device]) -> str:
    """The scene of a chart in which devices stand side by side: one that all have drawn, markers last.

    Raises InputError where there is none.
    """
    first = devices[0]
    for scene in dict.fromkeys((*_plain(first), *first.scenes)):
        if all(scene in device.scenes for device in devices):
            return scene
    raise InputError(f"{' and '.join(device.title for device in devices)} have no scene in common to plot")


def draw_chart(devices: Sequence[Device], scene: str, file: Path) -> None:
    """Milliseconds against the largest error of every setting that draws the base's picture, a panel for each
    device."""
    with chart(file, len(devices), (9.0 * len(devices), 5.2)) as (figure, panels):
        named = [_draw_panel(axes, device, scene) for axes, device in zip(panels, devices, strict=True)]
        panels[0].set_ylabel("largest error (peak 1)")
        handles, words = panels[0].get_legend_handles_labels()
        figure.legend(handles, words, loc="outside lower center", ncols=4, frameon=False)
        for axes, points in zip(panels, named, strict=True):
            label_points(figure, axes, points)


def _draw_panel(axes: Axes, device: Device, scene: str) -> list[tuple[float, float, str]]:
    """Draw one device's settings; returns those that have names, with their places."""
    points = device.same_picture(scene)
    points = points[points["knob"] != "blend_precision"]  # for truths, and many times as slow
    points = points.assign(error=points["maximum"].clip(lower=_LEAST))
    ladder = points[points["knob"].isin(("base", "alpha_cutoff"))].sort_values("error")
    names = pd.Series(list(zip(points["knob"], points["value"], strict=True)), index=points.index).map(
        _LABELLED
    )
    axes.set(xscale="log", yscale="log", xlabel="milliseconds per frame")
    axes.plot(points["ms"], points["error"], ".", color="#bbbbbb", label="every setting")
    axes.plot(ladder["ms"], ladder["error"], "-", color="#00798c", label="the cut-off alone")
    for knob, style, colour, words in (
        (PRESETS_KNOB, "o", "#d1495b", "presets"),
        ("alpha_cutoff", "o", "#00798c", None),
        (ALONE, "s", "#edae49", "one constant in an exact picture"),
    ):
        chosen = points[names.notna() & (points["knob"] == knob)]
        axes.plot(chosen["ms"], chosen["error"], style, color=colour, label=words)
    axes.axhline(INVISIBLE, color="#777777", linestyle="--", linewidth=0.8)
    axes.annotate(
        "half a step of 8 bits", (0, INVISIBLE), (4, 3), xycoords=("axes fraction", "data"),
        textcoords="offset points", fontsize=9, color="#555555",
    )  # fmt: skip
    axes.margins(0.08)
    plain_ticks(axes.xaxis)
    axes.set_title(literal(f"{scene} on {device.title}"))
    named = points[names.notna()]
    return list(zip(named["ms"], named["error"], names[names.notna()], strict=True))


def constants_table(devices: Sequence[Device]) -> Frame:
    """What each constant saves beside the exact picture on each device, and the error that it makes; no row
    for what nobody measured."""
    rows = []
    for constant in CONSTANTS:
        row: dict[str, str] = {"constant": constant.words, "used by": constant.users}
        there = False
        shared = _shared(devices)
        for scene in (shared, HARD) if any(HARD in device.scenes for device in devices) else (shared,):
            worst = []
            for device in devices:
                point = device.at(scene, constant.knob, constant.value)
                exact = device.at(scene, ALONE, "exact")
                if scene != HARD:
                    row[f"time, {device.kind}"] = percent(
                        None if point is None or exact is None else point["ratio"] / exact["ratio"]
                    )
                if point is not None and exact is not None:
                    worst.append(point["maximum"])
            there |= bool(worst)
            row[f"largest error, {scene}"] = number(max(worst, default=None))
        verdicts = [_verdict(device, constant) for device in devices]
        row["verdict"] = " / ".join(dict.fromkeys(word for word in verdicts if word))
        if there:
            rows.append(row)
    return pd.DataFrame(rows)


def _verdict(device: Device, constant: Constant) -> str:
    scene = _shared([device])
    point, exact = device.at(scene, constant.knob, constant.value), device.at(scene, ALONE, "exact")
    if point is None or exact is None:
        return ""
    verdict = device.verdict(point, exact)
    return "no effect" if verdict == "dominated" and point["maximum"] <= INVISIBLE / 2 else verdict


def ways_table(devices: Sequence[Device]) -> Frame:
    """What each way of drawing 3D Gaussians takes beside `ewa` on each device, and how far its picture is
    from the Gaussians themselves at most; no column for what nobody measured."""
    rows = []
    for way, words in WAYS.items():
        row = {"3D Gaussians": words}
        for scene in THICK:
            points = []
            for device in devices:
                point, ewa = (device.at(scene, "ellipsoid", name) for name in (way, "ewa"))
                if point is not None and ewa is not None:
                    points.append(point)
                    row[f"time, {scene}, {device.kind}"] = percent(point["ratio"] / ewa["ratio"])
            if points:
                row[f"largest error, {scene}"] = number(max(point["maximum"] for point in points))
        if len(row) > 1:
            rows.append(row)
    return pd.DataFrame(rows)


def orders_table(devices: Sequence[Device]) -> Frame:
    """What compositing by depth at each pixel takes beside the order of centres on each device, and how far
    each is from the exact picture in its own order at most; no row for a scene that nobody drew in both."""
    rows = []
    for scene in dict.fromkeys(scene for device in devices for scene in device.scenes):
        errors: dict[str, list[float]] = {"pixel": [], "centre": []}
        times = {}
        for device in devices:
            pixel, centre = (device.at(scene, "order", name) for name in errors)
            if pixel is not None and centre is not None:
                times[f"time, {device.kind}"] = percent(pixel["ratio"] / centre["ratio"])
                errors["pixel"].append(pixel["maximum"])
                errors["centre"].append(centre["maximum"])
        if times:
            worst = {f"largest error, `{name}`": number(max(found)) for name, found in errors.items()}
            rows.append({"`pixel` beside `centre`": scene} | worst | times)
    return pd.DataFrame(rows).fillna("-")


def linear_table(devices: Sequence[Device]) -> Frame:
    """What the linear image of EWA is wrong by, by distance and angle off the axis."""
    rows: Frame = pd.concat([device.summary.rows for device in devices])
    rows = rows[rows["what"] == LINEAR]
    found = {(row["knob"], str(row["value"])): row["maximum"] for _, row in rows.iterrows()}
    if not found:
        return pd.DataFrame()
    return pd.DataFrame(
        {"distance, standard deviations": str(distance)}
        | {f"{angle} degrees": number(found.get((f"{distance} sigma", str(angle)))) for angle in ANGLES}
        for distance in DISTANCES
    )


def markers_table(device: Device) -> Frame:
    """What Gaussians of a marker give, drawn sharp: time, PSNR from the print, how far it is read."""
    view, rows = f"{MARKER}@{TILT}", []
    if view not in device.scenes:
        return pd.DataFrame()
    points = device.of(view)
    for _, point in points[points["knob"] == MARKER_KNOB].iterrows():
        words = point["value"].removesuffix(_SHARP)
        if (words == "exact" or words != point["value"]) and "growth" not in words:
            rows.append(
                {
                    "marker": words,
                    "Gaussians per rectangle": fixed(point["per_rectangle"], 0),
                    "time": percent(point["ratio"]),
                    "PSNR, dB": fixed(point["ideal_psnr"]),
                    "corner error, px": number(point["corners_px"]),
                    "read up to": fixed(device.read_to(MARKER, point["knob"], point["value"]), 0),
                }
            )
    return pd.DataFrame(rows)


def choices(devices: Sequence[Device]) -> list[dict[str, str]]:
    """The cheapest setting on each device whose error nobody sees, on random scenes and on all scenes."""
    found = []
    for device in devices:
        plain = _plain(device)
        kind = "one's own scenes" if device.own else "random scenes"
        for words, scenes in ((kind, [s for s in plain if s != HARD]), ("all scenes", plain)):
            best = device.cheapest_within(scenes, INVISIBLE) if scenes else []
            if best:
                costs = ", ".join(f"{row['scene']} {percent(row['ratio'])}" for row in best)
                found.append({"kind": device.kind, "on": words, "setting": _words(best[0]), "costs": costs})
    return found


def _words(point: Row) -> str:
    plain = point["knob"] in ("base", PRESETS_KNOB, TOGETHER)
    return point["value"] if plain else f"{point['knob']} {point['value']}"


def _facts(device: Device) -> dict[str, str]:
    """`standard` beside gsplat's constants, on the scene that is plotted."""
    scene = _shared([device])
    ours, theirs = (device.at(scene, PRESETS_KNOB, name) for name in ("standard", "gsplat"))
    if ours is None or theirs is None:
        return {}
    better = math.floor(theirs["maximum"] / max(ours["maximum"], _LEAST))
    same = device.same_picture(scene)
    at_error = same[same["maximum"] <= theirs["maximum"]].nsmallest(1, "ratio").iloc[0]
    in_time = same[same["ratio"] <= theirs["ratio"] * 1.02].nsmallest(1, "maximum").iloc[0]
    return {
        "time": percent(ours["ratio"] / theirs["ratio"]),
        "better": f"{better}",
        "at_error": percent(at_error["ratio"] / theirs["ratio"]),
        "in_time": f"{math.floor(theirs['maximum'] / max(in_time['maximum'], _LEAST))}",
        "base_ms": fixed(device.base_ms(scene), 2),
        "noise": f"{device.noise(scene):.0%}",
    }


def _worst(device: Device, preset: str) -> float:
    """A preset's largest error on scenes that are no markers."""
    points = [device.at(scene, PRESETS_KNOB, preset) for scene in _plain(device)]
    return max((point["maximum"] for point in points if point is not None), default=0.0)


def _plain(device: Device) -> list[str]:
    """Users' own scenes, random scenes of disks, the largest first, and the hard cases."""
    order = [*device.own, *reversed(RANDOM), HARD]
    return sorted((s for s in device.scenes if s in order), key=order.index)


def _shared(devices: Sequence[Device]) -> str:
    """The scene that stands for all: of those that every device has the first, a user's own or the largest
    random one."""
    common = [s for s in _plain(devices[0]) if all(s in device.scenes for device in devices)]
    return common[0] if common else HARD


def _refused(device: Device):
    rows = device.summary.rows
    return rows[rows["error"].notna()].itertuples()


def _truth_error(device: Device) -> float:
    """Largest error of the reference renderings with order `centre`; with `pixel`, ties may resolve either
    way."""
    rows = device.summary.rows
    truths = rows[(rows["what"] == "truth") & ~rows["value"].str.endswith(", pixel", na=False)]
    worst = truths["maximum"].max()
    return 0.0 if pd.isna(worst) else float(worst)


def _short_names(devices: Sequence[Device]) -> list[str]:
    """cpu, gpu, gpu-2 ... for the names of files."""
    found: list[str] = []
    for device in devices:
        same = sum(name.partition("-")[0] == device.kind for name in found)
        found.append(device.kind if not same else f"{device.kind}-{same + 1}")
    return found
