"""Results of the robot's drive on disk."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from fidsplat.cameras import Trajectory
from fidsplat.errors import InputError, unknown
from fidsplat.experiments.localise import DISTANCES, RATE, VARIANTS, Localise, Variant
from fidsplat.experiments.sweep import differences
from fidsplat.files import atomic_write, writable_folder
from fidsplat.formats import load_trajectory, save_trajectory
from fidsplat.provenance import run_facts
from fidsplat.render import Renderer
from fidsplat.sim.robot import Run
from fidsplat.vision.detect import Detection

RESULTS, REPORT, CHART = "localise.json", "localise.md", "localise.svg"
_SHOWN = ("odometry", "paper", "exact")
"""variants whose way is drawn"""
_SPANS = (
    f"to {DISTANCES[0]:g} m",
    *(f"{near:g} to {far:g} m" for near, far in pairwise(DISTANCES)),
    f"beyond {DISTANCES[-1]:g} m",
)
HEADS = (
    *("", "ATE [cm]", "worst", "RPE", "heading [deg]", "tags", "refused"),
    *(f"[px] {span}" for span in _SPANS),
)


class LocaliseFolder:
    """Results on disk: one entry for each variant, trajectories as TUM, a chart and a page. What is there is
    not measured again.

    Raises InputError where the folder holds another experiment or results of another device or code, or
    cannot be written.
    """

    def __init__(self, folder: Path, asked: Localise, device: str, overwrite: bool = False) -> None:
        self.folder, self.asked = writable_folder(folder), asked
        self.key = {"rows": asked.rows, "plants": asked.plants, "seed": asked.seed, "speed": asked.speed}
        self.results: dict[str, Any] = {
            "run": run_facts(device, asked.seed),
            "asked": self.key,
            "variants": {},
        }
        file = self.folder / RESULTS
        if file.exists() and not overwrite:
            try:
                before = json.loads(file.read_text("utf-8"))
            except (OSError, ValueError) as error:
                raise InputError(f"{file} cannot be read ({error}); --overwrite measures again") from None
            if not isinstance(before, dict) or not isinstance(before.get("variants"), dict):
                raise InputError(f"{file} holds no results of a drive; --overwrite measures again")
            if before.get("asked") != self.key:
                raise InputError(
                    f"{file} is of another drive, {before.get('asked')}; give another folder, or --overwrite"
                )
            ran = before.get("run")
            if differ := differences(ran if isinstance(ran, dict) else {}, self.results["run"]):
                raise InputError(
                    f"{file} holds results of another {' and '.join(differ)}; give another folder, or "
                    "--overwrite"
                )
            self.results = before

    def measure(self, names: list[str], renderer: Renderer) -> Iterator[tuple[str, float]]:
        """Measure what is left of the variants; yields words and the share of them that is done."""
        for name in names:
            if name not in VARIANTS:
                raise InputError(unknown("variant", name, VARIANTS))
        left = [name for name in names if name not in self.results["variants"]]
        if not left:
            return
        runs: dict[float | None, Run] = {None: self._driven(None)}
        seen: dict[Variant, list[list[Detection]]] = {}
        for done, name in enumerate(left):
            variant = VARIANTS[name]
            if variant.speed not in runs:
                runs[variant.speed] = self._driven(variant.speed)
            run, taken = runs[variant.speed], variant.taken
            camera = replace(self.asked.camera, lens=variant.lens)
            if taken is not None and taken not in seen:
                found, count = [], len(self.asked.shots(run))
                for codes in self.asked.sightings(taken, run, renderer):
                    found.append(codes)
                    yield name, (done + len(found) / count) / len(left)
                seen[taken] = found
            sightings = None if taken is None else seen[taken]
            if variant.ideal and sightings is not None:
                sightings = self.asked.ideal(run, sightings)
            noise = 0.05 if variant.ideal else 0.5
            path, facts = self.asked.localised(run, sightings, camera, noise, variant.reach)
            if sightings is not None:
                facts["corners"] = self.asked.corner_errors(run, sightings, camera)
            save_trajectory(path, self.folder / _tum(name))
            self.results["variants"][name] = facts
            with atomic_write(self.folder / RESULTS) as stream:
                stream.write(json.dumps(self.results, indent=2).encode())
            yield name, (done + 1) / len(left)

    def _driven(self, speed: float | None) -> Run:
        """A drive, its truth kept beside the results."""
        run = self.asked.run(speed)
        if speed is None:
            self.results["length_m"] = run.length
        name = "truth" if speed is None else f"truth {speed:g} m/s"
        save_trajectory(Trajectory(run.times, run.poses), self.folder / _tum(name))
        return run

    def rows(self) -> list[tuple[str, ...]]:
        """A row of text for each variant: name, errors in centimetres, degrees and pixels, tags."""
        return [
            (
                name,
                f"{100 * facts['ate_m']:.2f}",
                f"{100 * facts['worst_m']:.2f}",
                f"{100 * facts['rpe_m']:.2f}",
                f"{facts['heading_deg']:.3f}",
                str(facts["tags"]),
                str(facts["refused"]),
                *(
                    "" if corners["median_px"] is None else f"{corners['median_px']:.3f}"
                    for corners in facts.get("corners", [{"median_px": None}] * (len(DISTANCES) + 1))
                ),
            )
            for name, facts in self.results["variants"].items()
        ]

    def write_chart(self) -> Path:
        """The drive from above, as it was and as it was taken to be; and the errors of all variants. Needs
        matplotlib."""
        from fidsplat.experiments.charts import COLOURS, chart, legend_above

        errors = {name: 100 * facts["ate_m"] for name, facts in self.results["variants"].items()}
        shown = [name for name in _SHOWN if name in errors]
        with chart(self.folder / CHART, panels=2, size=(11.0, 4.6), one_scale=False) as (figure, axes):
            for number, name in enumerate(["truth", *shown]):
                path = load_trajectory(self.folder / _tum(name)).poses[::10, :2, 3]  # every fifth of a second
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
        return self.folder / CHART

    def write_page(self) -> Path:
        """The table as a page."""
        lines = [
            "# A robot among tags",
            "",
            f"{self.results['length_m']:.1f} m through a greenhouse of {self.asked.rows} rows, "
            f"{RATE:g} pictures a second of 640 x 480, on {self.results['run']['device']}. RPE over a metre; "
            "[px]: the median error of tags' corners, by how far away these are.",
            "",
            f"| {' | '.join(HEADS)} |",
            f"|{'---|' * len(HEADS)}",
            *(f"| {' | '.join(row)} |" for row in self.rows()),
            "",
            f"![The drive from above]({CHART})",
            "",
        ]
        with atomic_write(self.folder / REPORT) as stream:
            stream.write("\n".join(lines).encode())
        return self.folder / REPORT


def _tum(name: str) -> str:
    return f"{re.sub('[^a-z0-9.]+', '-', name)}.tum"
