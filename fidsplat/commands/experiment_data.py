"""Commands `fidsplat experiment` for data: Blender's images, plants, results of shards, reports."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

from fidsplat.commands.options import (
    BlenderEnvironment,
    Device,
    Folders,
    Json,
    ReportTo,
    repeatable,
    require_packages,
)
from fidsplat.commands.output import (
    console,
    delayed_progress,
    report,
    show_progress,
    steps_shown,
)
from fidsplat.experiments.plants import PlantSettings
from fidsplat.experiments.settings import BlenderSettings
from fidsplat.util.errors import InputError


@repeatable
@dataclass(frozen=True)
class Blender(BlenderSettings):
    """Render every marker's views with Blender (Cycles on the CPU), the paper's ground truth.

    --install makes a virtual environment with bpy (about 1 GB, needs Python 3.11). Without it, missing images
    are rendered, about 3 s each on two cores: 20 test views for each of 25 markers, with --training 17 more.

    Examples:
      fidsplat experiment blender --install
      fidsplat experiment blender
      fidsplat experiment blender --view raw --category small --markers 1 --samples 16
    """

    install: bool = False
    """install Blender instead of rendering"""
    environment: BlenderEnvironment = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments import blender

        environment = self.environment or blender.default_environment()
        if self.install:
            with steps_shown(console(self.json), "installing Blender") as update:
                python = blender.install(environment, update)
            return report(self.json, {"python": str(python)}, f"Blender is in {environment}")
        self.check()
        views, done = self.view or blender.VIEW_NAMES, 0
        for view in views:
            blender.ready(view, environment)
        for view in views:
            blender.record_images(self.out, view, self.seed, self.samples)
        for view in views:
            jobs = self.jobs(view)
            images = blender.render(jobs, view, environment, self.samples, threads=self.threads)
            done += len(list(show_progress(f"view {view}", images, sum(len(job["images"]) for job in jobs))))
        facts = {"folder": str(self.out), "pictures": done}
        return report(self.json, facts, f"{done} images in {self.out}")


@repeatable
@dataclass
class Plants:
    """Make plants: meshes, images of them by Blender, and splats trained on these images.

    `fidsplat greenhouse --plants-from DIR` uses DIR/KIND-NUMBER.ply; the images remain as data sets.
    Existing plants are unchanged, and an interrupted run resumes. `fidsplat experiment blender --install`
    installs Blender. With --iterations 0 plants are disks on the meshes, and Blender is not needed.

    Examples:
      fidsplat experiment blender --install
      fidsplat experiment plants -o plants && fidsplat greenhouse --plants-from plants
      fidsplat experiment plants -o plants --kind tomato --each 10
      fidsplat experiment plants -o sampled --iterations 0
    """

    out: str = "fidsplat-plants"
    """DIR: folder"""
    plants: PlantSettings = field(default_factory=PlantSettings)
    environment: BlenderEnvironment = None
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments import plants
        from fidsplat.experiments.blender import default_environment

        environment = self.environment or default_environment()
        with delayed_progress() as progress:
            written = list(
                plants.write_plants(self.plants, Path(self.out), environment, self.device, progress)
            )
        facts = {"plants": [{"file": str(file), "psnr": score} for file, score in written]}
        rows = [(str(file), "" if score is None else f"{score:.1f}") for file, score in written]
        return report(self.json, facts, table=("plants", ("file", "PSNR of test views [dB]"), rows))


@dataclass
class Merge:
    """Join results of shards: NAME-1-of-4.jsonl and so on in the folders become NAME.jsonl.

    Other results in NAME.jsonl are kept. Missing shards, and results that differ in device, version or code,
    cause warnings.

    Examples:
      fidsplat experiment merge shards -o results
      fidsplat experiment merge machine-1 machine-2 -o results
    """

    folders: Folders
    """DIR: folders with results of shards"""
    out: str = "fidsplat-experiments"
    """DIR: folder for the joined results"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments import tags
        from fidsplat.experiments.run import NAMES
        from fidsplat.experiments.sweep import merge, missing_shards, result_files

        result, lines = {}, []
        for name in (*NAMES, tags.NAME):
            if not (files := result_files([Path(folder) for folder in self.folders], name)):
                continue
            target = Path(self.out) / f"{name}.jsonl"
            joined, missing = merge(files, target), missing_shards(files)
            if missing:
                warnings.warn(f"{name}: missing shard {', '.join(missing)}", stacklevel=2)
            if joined.differ:
                text = f"{name}: joined results differ in {' and '.join(joined.differ)}"
                warnings.warn(f"{text}; the report lists them", stacklevel=2)
            facts = {"file": str(target), "files": len(files), "points": joined.points}
            result[name] = facts | {"repeated": joined.repeated, "missing": missing}
            twice = f", {joined.repeated} of them repeated" if joined.repeated else ""
            lines.append(f"{target}: {joined.points} results of {len(files)} files{twice}")
        if not result:
            raise InputError(f"DIR must contain results of shards, got {', '.join(self.folders) or 'no DIR'}")
        return report(self.json, result, *lines)


@dataclass
class Report:
    """Write report.md: the paper's tables with our results next to the paper's.

    Its folder, or for FILE.md a folder of that name, receives charts and small tables of all results, from
    which the report can be made again. The report lists missing measurements.

    Examples:
      fidsplat experiment report
      fidsplat experiment report results -o devlog/results.md
    """

    folders: Folders = ()
    """DIR: folders with results (default: fidsplat-experiments)"""
    out: ReportTo = None
    json: Json = False

    def run(self) -> int:
        folders = [Path(folder) for folder in self.folders or ("fidsplat-experiments",)]
        files = write_report(folders, Path(self.out or folders[0]))
        return report(self.json, {"files": files}, f"report in {files[0]}")


def write_report(folders: list[Path], out: Path) -> list[str]:
    """Write the report; returns its files, first the page."""
    require_packages()
    from fidsplat.experiments.report import make_report

    return [str(file) for file in make_report(folders, out)]
