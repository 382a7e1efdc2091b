"""Sweep over the variants of the robot's drive, with trajectories, chart and report."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pandas as pd

from fidsplat.cameras import Trajectory
from fidsplat.experiments.charts import COLOURS, chart, legend_above
from fidsplat.experiments.localise import DISTANCES, RATE, VARIANTS, Drive, Variant
from fidsplat.experiments.pages import fixed, write_page
from fidsplat.experiments.summary import Frame
from fidsplat.experiments.sweep import Key, Results, Sweep
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.files import writable_folder
from fidsplat.util.provenance import run_facts
from fidsplat.vision.detect import Detection
from fidsplat.worlds.robot import Run

RESULTS, REPORT, CHART = "localise.jsonl", "localise.md", "localise.svg"
Found = Mapping[str, Mapping[str, Any]]
"""results by variant"""
_SHOWN = ("odometry", "paper", "exact")
"""variants with a plotted trajectory"""
_SPANS = (
    f"to {DISTANCES[0]:g} m",
    *(f"{near:g} to {far:g} m" for near, far in pairwise(DISTANCES)),
    f"beyond {DISTANCES[-1]:g} m",
)


def drive_sweep(
    out: Path,
    asked: Drive,
    names: Sequence[str],
    renderer: Renderer,
    tell: Callable[[str, float], object],
    overwrite: bool = False,
) -> Sweep:
    """Sweep over the variants of these names.

    tell: called with a variant's name and the share of its pictures that is done.

    Raises:
        InputError: an unknown name; the folder holds results of another greenhouse, device or code, or cannot
            be written.
    """
    for name in names:
        if name not in VARIANTS:
            raise InputError(unknown("variant", name, VARIANTS))
    facts = run_facts(renderer.device.title, asked.seed)
    facts |= {"scene": {"rows": asked.rows, "plants": asked.plants, "speed": asked.speed}}
    results = Results(writable_folder(out) / RESULTS, facts, overwrite)
    drive = _Drive(out, asked, renderer, tell)
    return Sweep("drive", results, [{"variant": name} for name in names], drive.begin)


class _Drive:
    """Measurement of variants; shared drives and detections are cached."""

    def __init__(
        self, folder: Path, asked: Drive, renderer: Renderer, tell: Callable[[str, float], object]
    ) -> None:
        self._folder, self._asked, self._renderer, self._tell = folder, asked, renderer, tell
        self._runs: dict[float | None, Run] = {}
        self._seen: dict[Variant, list[list[Detection]]] = {}

    def begin(self, key: Key) -> Callable[[], dict[str, Any]]:
        """Render and detect for a variant; returns the estimation as work."""
        name = key["variant"]
        variant = VARIANTS[name]
        run = self._driven(variant.speed)
        sightings = None if variant.taken is None else self._sightings(name, variant.taken, run)
        return lambda: self._localised(name, variant, run, sightings)

    def _driven(self, speed: float | None) -> Run:
        """A drive; its ground truth is saved with the results."""
        if speed not in self._runs:
            run = self._runs[speed] = self._asked.run(speed)
            save_trajectory(Trajectory(run.times, run.poses), self._folder / _tum(_truth(speed)))
        return self._runs[speed]

    def _sightings(self, name: str, taken: Variant, run: Run) -> list[list[Detection]]:
        if taken not in self._seen:
            found, count = [], len(self._asked.image_indices(run))
            for codes in self._asked.sightings(taken, run, self._renderer):
                found.append(codes)
                self._tell(name, len(found) / count)
            self._seen[taken] = found
        return self._seen[taken]

    def _localised(
        self, name: str, variant: Variant, run: Run, sightings: list[list[Detection]] | None
    ) -> dict[str, Any]:
        asked, camera = self._asked, replace(self._asked.camera, lens=variant.lens)
        if variant.ideal and sightings is not None:
            sightings = asked.ideal(run, sightings)
        noise = 0.05 if variant.ideal else 0.5
        path, facts = asked.localised(run, sightings, camera, noise, variant.reach)
        if sightings is not None:
            facts["corners"] = asked.corner_errors(run, sightings, camera)
        save_trajectory(path, self._folder / _tum(name))
        return facts | {"length_m": run.length}


def found_of(results: Results) -> dict[str, dict[str, Any]]:
    """Results of a sweep file by variant."""
    return {record.key["variant"]: record.result for record in results.done.values()}


def table_of(found: Found) -> Frame:
    """Table row of each variant: errors in centimetres, degrees and pixels, and tags."""
    unseen = [{"median_px": None}] * len(_SPANS)
    return pd.DataFrame(
        {
            "": name,
            "ATE [cm]": f"{100 * facts['ate_m']:.2f}",
            "worst": f"{100 * facts['worst_m']:.2f}",
            "RPE": f"{100 * facts['rpe_m']:.2f}",
            "heading [deg]": f"{facts['heading_deg']:.3f}",
            "tags": facts["tags"],
            "refused": facts["refused"],
        }
        | {
            f"[px] {span}": fixed(corners["median_px"], 3)
            for span, corners in zip(_SPANS, facts.get("corners", unseen), strict=True)
        }
        for name, facts in found.items()
    )


def write_report(folder: Path, asked: Drive, device: str, found: Found) -> Path:
    """Write the report and its chart."""
    _draw(folder, found)
    context = {
        "length": next(iter(found.values()))["length_m"],
        "rows": asked.rows,
        "rate": RATE,
        "device": device,
        "table": table_of(found),
        "chart": CHART,
    }
    write_page(folder / REPORT, folder, "localise.md.j2", context)
    return folder / REPORT


def _draw(folder: Path, found: Found) -> None:
    """Chart of true and estimated trajectories, and of the errors of all variants."""
    errors = {name: 100 * facts["ate_m"] for name, facts in found.items()}
    shown = [name for name in _SHOWN if name in errors]
    with chart(folder / CHART, panels=2, size=(11.0, 4.6), one_scale=False) as (figure, axes):
        # the drive at the default speed, or that of the first measured variant
        speeds = [VARIANTS[name].speed for name in found]
        for number, name in enumerate([_truth(None if None in speeds else speeds[0]), *shown]):
            path = load_trajectory(folder / _tum(name)).poses[::10, :2, 3]  # every fifth of a second
            width, colour = (3.0, "#bbbbbb") if number == 0 else (1.0, COLOURS[number % len(COLOURS)])
            axes[0].plot(path[:, 0], path[:, 1], label=name, color=colour, linewidth=width)
        axes[0].set_aspect("equal")
        axes[0].set_xlabel("x [m]")
        axes[0].set_ylabel("y [m]")
        axes[1].barh(list(errors)[::-1], list(errors.values())[::-1], color=COLOURS[4])
        axes[1].set_xscale("log")
        axes[1].set_xlabel("absolute trajectory error [cm]")
        axes[1].grid(axis="y", visible=False)
        legend_above(figure, axes[0])


def _truth(speed: float | None) -> str:
    """File name of the ground truth of a speed; None: the default speed."""
    return "truth" if speed is None else f"truth {speed:g} m/s"


def _tum(name: str) -> str:
    return f"{re.sub('[^a-z0-9.]+', '-', name)}.tum"
