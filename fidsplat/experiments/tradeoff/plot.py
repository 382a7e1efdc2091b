"""Charts of time and error of quality settings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fidsplat.experiments.charts import Axes, chart, label_points, literal, plain_ticks
from fidsplat.experiments.tradeoff.points import ABLATION, PRESET
from fidsplat.experiments.tradeoff.scenes import HARD, RANDOM
from fidsplat.experiments.tradeoff.summary import DeviceResults, load
from fidsplat.util.errors import InputError

INVISIBLE = 1 / 512
"""half an 8-bit level"""
SMALLEST = 1e-7
"""lower limit of the error axis, at which smaller errors are plotted"""
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


def write_plot(folders: Sequence[Path], file: Path) -> None:
    """Write one chart of results with a panel for each device.

    Raises InputError if there are no results, the devices have no common scene, or the file cannot be
    written.
    """
    devices = load(folders)
    first = devices[0]
    for scene in dict.fromkeys((*disk_scenes(first), *first.scenes)):
        if all(scene in device.scenes for device in devices):
            write_chart(devices, scene, file)
            return
    titles = ", ".join(device.title for device in devices)
    raise InputError(
        f"devices of a chart must have measurements of one common scene, got none of {titles}; measure "
        "a scene on all of them"
    )


def write_chart(devices: Sequence[DeviceResults], scene: str, file: Path) -> None:
    """Write a chart of time and maximum error of settings, with a panel for each device.

    Settings that change the image definition are omitted, since their errors are not comparable.
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
    points = points[points["value"] != "float64"]  # only for reference images, and much slower
    points = points.assign(
        error=points["maximum"].clip(lower=SMALLEST),
        label=[_LABELS.get(key) for key in zip(points["setting"], points["value"], strict=True)],
    )
    labelled = points[points["label"].notna()]
    cutoffs = points[points["setting"].isin(("base", "alpha_cutoff"))].sort_values("error")
    axes.set(xscale="log", yscale="log", xlabel="milliseconds per frame")
    axes.plot(points["ms"], points["error"], ".", color="#bbbbbb", label="every setting")
    axes.plot(cutoffs["ms"], cutoffs["error"], "-", color="#00798c", label="only the cut-off")
    for setting, style, color, text in (
        (PRESET, "o", "#d1495b", "presets"),
        ("alpha_cutoff", "o", "#00798c", None),
        (ABLATION, "s", "#edae49", "one constant in an exact image"),
    ):
        chosen = labelled[labelled["setting"] == setting]
        axes.plot(chosen["ms"], chosen["error"], style, color=color, label=text)
    axes.axhline(INVISIBLE, color="#777777", linestyle="--", linewidth=0.8)
    axes.annotate(
        "half an 8-bit level", (0, INVISIBLE), (4, 3), xycoords=("axes fraction", "data"),
        textcoords="offset points", fontsize=9, color="#555555",
    )  # fmt: skip
    axes.margins(0.08)
    plain_ticks(axes.xaxis)
    axes.set_title(literal(f"{scene} on {device.title}"))
    return list(labelled[["ms", "error", "label"]].itertuples(index=False, name=None))


def disk_scenes(device: DeviceResults) -> list[str]:
    """The user's scenes, random scenes of disks from the largest on, and the hard cases."""
    order = [*device.own, *reversed(RANDOM), HARD]
    return sorted((scene for scene in device.scenes if scene in order), key=order.index)
