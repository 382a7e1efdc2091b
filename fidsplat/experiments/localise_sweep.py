"""Sweep over the variants of the robot's drive, with trajectories, chart and report."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pandas as pd

from fidsplat.cameras import Trajectory
from fidsplat.experiments.charts import COLORS, chart, legend_above
from fidsplat.experiments.localise import DISTANCES, RATE, VARIANTS, Drive, Variant, record, recorded
from fidsplat.experiments.pages import fixed, write_page
from fidsplat.experiments.summary import Table
from fidsplat.experiments.sweep import Key, Results, Sweep, Work
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.logs import RobotLog, check_log
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.progress import Progress
from fidsplat.util.provenance import digest_of, run_facts
from fidsplat.worlds.robot import Run

RESULTS, REPORT, CHART = "localise.jsonl", "localise.md", "localise.svg"
VariantResults = Mapping[str, Mapping[str, Any]]
"""results by variant"""
_PLOTTED = ("odometry", "paper", "exact", "no tags", "no wheels")
"""variants with a plotted trajectory"""
_SPANS = (
    f"to {DISTANCES[0]:g} m",
    *(f"{near:g} to {far:g} m" for near, far in pairwise(DISTANCES)),
    f"beyond {DISTANCES[-1]:g} m",
)


def drive_sweep(
    out: Path,
    drive: Drive,
    names: Sequence[str],
    renderer: Renderer,
    progress: Progress,
    overwrite: bool = False,
) -> Sweep:
    """Sweep over variants by name.

    Raises:
        InputError: a name is unknown, or the folder has results of another greenhouse, device or code or
            cannot be written.
    """
    for name in names:
        if name not in VARIANTS:
            raise InputError(unknown("variant", name, VARIANTS))
    facts = run_facts(renderer.device.title, drive.seed)
    facts |= {"scene": {"rows": drive.rows, "plants": drive.plants, "speed": drive.speed}}
    results = Results(out / RESULTS, facts, overwrite)

    @cache
    def run_at(speed: float | None) -> Run:
        """The drive at a speed; its ground truth is saved with the results."""
        run = drive.run(speed)
        save_trajectory(Trajectory(run.times, run.poses), out / _tum(_truth(speed)))
        return run

    @cache
    def log_of(rendering: Variant, name: str) -> Path:
        """ROS 2 log of the measurements that all variants use; an interrupted sweep reads existing logs."""
        path, run = out / f"{_stem(name)}.mcap", run_at(rendering.speed)
        source = digest_of((drive, rendering, facts["code"], facts["device"]))
        if not check_log(path, overwrite, source):
            count = len(drive.image_indices(run))
            with RobotLog(path, up=(0, 0, 1), overwrite=overwrite, source=source) as log:
                for done, _ in enumerate(record(drive, rendering, run, renderer, log), 1):
                    progress(name, done / count)
        return path

    def begin(key: Key) -> Work:
        """Log the measurements of a variant; returns the function that estimates poses."""
        name = key["variant"]
        variant = VARIANTS[name]
        first = next(other for other in VARIANTS if VARIANTS[other].rendering == variant.rendering)
        log = log_of(variant.rendering, first)
        return partial(_estimate, out / _tum(name), drive, variant, run_at(variant.speed), log)

    return Sweep("drive", results, [{"variant": name} for name in names], begin)


def _estimate(file: Path, drive: Drive, variant: Variant, poses: Run, log: Path) -> dict[str, Any]:
    """Estimate the trajectory of a variant from a ROS 2 log and write it; returns its errors."""
    camera = replace(drive.camera, lens=variant.lens)
    run, detections, scans = recorded(log, poses)
    if variant.ideal:
        detections = drive.ideal_corners(run, detections)
    path, facts = drive.localise(
        run,
        detections or None,
        camera,
        0.05 if variant.ideal else 0.5,
        scans or None,
        variant,
    )
    if detections:
        facts["corners"] = drive.corner_errors(run, detections, camera)
    save_trajectory(path, file)
    return facts | {"length_m": run.length}


def found_of(results: Results) -> dict[str, dict[str, Any]]:
    """Results of a sweep file by variant."""
    return {record.key["variant"]: record.result for record in results.done.values()}


def table_of(variants: VariantResults) -> Table:
    """Table with a row per variant: errors in centimetres, degrees and pixels, and numbers of tags."""
    no_corners = [{"median_px": None}] * len(_SPANS)
    return pd.DataFrame(
        {
            "": name,
            "ATE [cm]": f"{100 * facts['ate_m']:.2f}",
            "worst": f"{100 * facts['worst_m']:.2f}",
            "RPE": f"{100 * facts['rpe_m']:.2f}",
            "heading [deg]": f"{facts['heading_deg']:.3f}",
            "tags": facts["tags"],
            "scans": facts["scans"],
            "refused": facts["refused"],
        }
        | {
            f"[px] {span}": fixed(corners["median_px"], 3)
            for span, corners in zip(_SPANS, facts.get("corners", no_corners), strict=True)
        }
        for name, facts in variants.items()
    )


def write_report(folder: Path, drive: Drive, device: str, variants: VariantResults) -> Path:
    _write_chart(folder, variants)
    context = {
        "length": next(iter(variants.values()))["length_m"],
        "rows": drive.rows,
        "rate": RATE,
        "device": device,
        "table": table_of(variants),
        "chart": CHART,
    }
    write_page(folder / REPORT, folder, "localise.md.j2", context)
    return folder / REPORT


def _write_chart(folder: Path, variants: VariantResults) -> None:
    """Write a chart of true and estimated trajectories, and of the errors of all variants."""
    errors = {name: 100 * facts["ate_m"] for name, facts in variants.items()}
    shown = [name for name in _PLOTTED if name in errors]
    with chart(folder / CHART, panels=2, size=(11.0, 4.6), one_scale=False) as (figure, axes):
        # show the drive at the default speed, else at the speed of the first measured variant
        speeds = [VARIANTS[name].speed for name in variants]
        for number, name in enumerate([_truth(None if None in speeds else speeds[0]), *shown]):
            path = load_trajectory(folder / _tum(name)).poses[::10, :2, 3]  # every 0.2 s
            width, color = (3.0, "#bbbbbb") if number == 0 else (1.0, COLORS[number % len(COLORS)])
            axes[0].plot(path[:, 0], path[:, 1], label=name, color=color, linewidth=width)
        axes[0].set_aspect("equal")
        axes[0].set_xlabel("x [m]")
        axes[0].set_ylabel("y [m]")
        axes[1].barh(list(errors)[::-1], list(errors.values())[::-1], color=COLORS[4])
        axes[1].set_xscale("log")
        axes[1].set_xlabel("absolute trajectory error [cm]")
        axes[1].grid(axis="y", visible=False)
        legend_above(figure, axes[0])


def _truth(speed: float | None) -> str:
    """File name of the ground truth of a speed; None: the default speed."""
    return "truth" if speed is None else f"truth {speed:g} m/s"


def _tum(name: str) -> str:
    return f"{_stem(name)}.tum"


def _stem(name: str) -> str:
    return re.sub("[^a-z0-9.]+", "-", name.lower())
