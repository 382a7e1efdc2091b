"""Settings of the paper's experiments, whose fields are the options of `fidsplat experiment`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

from fidsplat.experiments.angles import parse_tilts
from fidsplat.experiments.blender import FULL_SAMPLES, VIEW_NAMES, check_images, marker_job
from fidsplat.experiments.methods import IDEAL, method_names
from fidsplat.experiments.setup import MARKERS, PROTOCOLS, SEED, chosen_categories
from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError, unknown


@dataclass(frozen=True)
class FolderSettings:
    """Folder of an experiment's results, and seed."""

    out: Path | None = None
    """Folder for results. By default fidsplat-experiments, with --quick fidsplat-experiments-quick."""
    seed: int = SEED
    """Seed of texts and views."""

    def __post_init__(self) -> None:
        whole_number("--seed", self.seed, 0, 2**63 - 1)

    @property
    def folder(self) -> Path:
        return self.out or Path("fidsplat-experiments")


@dataclass(frozen=True)
class ShardSettings(FolderSettings):
    """Fraction of a sweep that one machine measures."""

    shard: str | None = None
    """Part of the work to measure, as i/n; `fidsplat experiment merge` joins the parts."""
    overwrite: bool = False
    """Replace existing results."""

    def file(self, name: str) -> Path:
        """File for the results of an experiment."""
        ending = "" if self.shard is None else "-" + self.shard.replace("/", "-of-")
        return self.folder / f"{name}{ending}.jsonl"


@dataclass(frozen=True)
class MarkerSettings(FolderSettings):
    """Markers of an experiment."""

    category: tuple[str, ...] = ()
    """Category of markers: apriltag, small, medium, large or huge. By default all; repeat for several."""

    markers: int | None = None
    """Number of markers of each category, 1 to 5. By default 5, in a quick run 1."""

    @property
    def marker_count(self) -> int:
        return MARKERS if self.markers is None else self.markers

    def check(self) -> None:
        """Raise InputError for settings that cannot be used."""
        chosen_categories(self.category)
        if not 1 <= self.marker_count <= MARKERS:
            raise InputError(f"--markers must be 1 to {MARKERS}, got {self.markers}")


@dataclass(frozen=True)
class BlenderSettings(MarkerSettings):
    """Markers and images that Blender renders."""

    out: Path = Path("fidsplat-experiments/blender")
    """Folder for the images."""
    view: tuple[str, ...] = ()
    """View transform: standard or raw. By default both."""
    training: bool = False
    """Render the training views as well."""
    samples: int = FULL_SAMPLES
    """Samples per pixel."""
    threads: int | None = None
    """Threads of Cycles (default: one per core)."""

    def check(self) -> None:
        super().check()
        for name in ("samples", "threads"):
            if (number := getattr(self, name)) is not None and number < 1:
                raise InputError(f"--{name} must be at least 1, got {number}")

    def jobs(self, view: str) -> list[dict]:
        """Jobs of `fidsplat.experiments.blender.render` for a view."""
        return [
            marker_job(category, index, self.seed, self.out, view, self.training)
            for category in chosen_categories(self.category)
            for index in range(self.marker_count)
        ]


@dataclass(frozen=True)
class MeasureSettings(ShardSettings, MarkerSettings):
    """Settings of all experiments that measure."""

    quick: bool = False
    """Measure one marker of each category with few tilts and views, in minutes."""

    @property
    def folder(self) -> Path:
        """Folder for results; quick and complete results never share a file."""
        return self.out or Path("fidsplat-experiments" + ("-quick" if self.quick else ""))

    @property
    def marker_count(self) -> int:
        return 1 if self.quick and self.markers is None else super().marker_count


@dataclass(frozen=True)
class ImageSettings(MeasureSettings):
    """Settings of experiments that evaluate rendered images."""

    device: str | None = None
    """D: device; see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)"""
    mixture: tuple[str, ...] = ()
    """Mixture of Gaussians. By default all; repeat for several."""
    trained: Path | None = None
    """Folder with trained models for the 2DGS columns, such as 2dgs-17/small-0.ply."""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """Number of threads that evaluate images. By default one per core."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of the compared methods, each a row of the tables."""
        return method_names(self.mixture, self.trained)

    def check(self) -> None:
        super().check()
        if self.workers < 1:
            raise InputError(f"--workers must be at least 1 thread, got {self.workers}")
        method_names(self.mixture)
        folder = self.trained
        if folder is None or self.methods == (IDEAL,):
            return
        if not folder.is_dir():
            raise InputError(
                f"--trained must be a folder with models such as 2dgs-17/small-0.ply, got {folder}; train "
                "models with benchmarks/baseline.py"
            )
        models = [method for method in self.methods if method.startswith("2dgs-")]
        if not models:
            raise InputError(
                f"--trained must have at least one of the folders 2dgs-3, 2dgs-5, 2dgs-9 and 2dgs-17, "
                f"got {folder}; train models with benchmarks/baseline.py"
            )
        for model, category, index in product(
            models, chosen_categories(self.category), range(self.marker_count)
        ):
            file = folder / model / f"{category.name}-{index}.ply"
            if not file.is_file():
                raise InputError(
                    f"{file} must be a trained model, got no file; train it, or restrict the markers with "
                    "--category and --markers"
                )


@dataclass(frozen=True)
class AngleSettings(ImageSettings):
    """Settings of the experiment on tilts."""

    protocol: tuple[str, ...] = ()
    """Protocol: fixed-plane or fixed-module. By default both."""
    tilts: str | None = None
    """Tilts in degrees as first:last:step, joined by commas. By default 0:89.8:0.2."""
    ideal: bool = False
    """Measure only the ideal texture, the upper limit of the detectors; no device is opened."""

    @property
    def methods(self) -> tuple[str, ...]:
        return (IDEAL,) if self.ideal else super().methods

    def check(self) -> None:
        super().check()
        for name in self.protocol:
            if name not in PROTOCOLS:
                raise InputError(unknown("protocol", name, PROTOCOLS))
        if self.tilts is not None:
            parse_tilts(self.tilts)


@dataclass(frozen=True)
class ViewSettings(ImageSettings):
    """Settings of the experiment on novel views."""

    blender: Path | None = None
    """Folder with Blender's images. By default the folder `blender` in the folder for results."""
    lpips: bool = False
    """Also measure LPIPS, by the package lpips."""

    @property
    def blender_folder(self) -> Path:
        return self.folder / "blender" if self.blender is None else self.blender

    def check(self) -> None:
        super().check()
        if self.blender is not None and not self.blender.is_dir():
            raise InputError(
                f"--blender must be a folder that `fidsplat experiment blender` wrote, got {self.blender}"
            )
        for view in VIEW_NAMES:
            check_images(self.blender_folder, view, self.seed)


@dataclass(frozen=True)
class ExperimentSettings(AngleSettings, ViewSettings):
    """Settings of all experiments."""
