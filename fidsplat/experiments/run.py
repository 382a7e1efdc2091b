"""Running the experiments: what each consists of, with which settings, and where its results go."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fidsplat.errors import InputError
from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.blender import VIEW_NAMES, check_pictures
from fidsplat.experiments.methods import IDEAL, Painter, method_names
from fidsplat.experiments.records import Records, shard
from fidsplat.experiments.setup import MARKERS, PROTOCOLS, SEED, TEST_VIEWS, chosen_categories
from fidsplat.files import writable_folder
from fidsplat.provenance import run_facts
from fidsplat.render import Renderer
from fidsplat.vision.lpips import load_lpips, weights_name
from fidsplat.vision.metrics import metric_versions
from fidsplat.vision.readers import reader_versions

NAMES = (counts.NAME, localisation.NAME, views.NAME, angles.NAME)
"""the experiments that measure, quickest first"""
QUICK_VIEWS = 1


@dataclass(frozen=True)
class Settings:
    """What a run is to measure."""

    out: Path
    device: str = "opencl"
    quick: bool = False
    """one marker of each category, few tilts and views"""
    seed: int = SEED
    categories: tuple[str, ...] = ()
    mixtures: tuple[str, ...] = ()
    protocols: tuple[str, ...] = ()
    tilts: str | None = None
    markers: int | None = None
    """of each category; None for 5, or 1 in a quick run"""
    trained: Path | None = None
    """folder with trained models, see `Painter`"""
    blender: Path | None = None
    """folder with Blender's pictures; None for "blender" in ``out``"""
    lpips: Path | None = None
    """file with LPIPS weights, see `fidsplat.vision.lpips.load_lpips`"""
    part: str | None = None
    """"i/n\""""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """threads that look at pictures"""
    anew: bool = False
    ideal_only: bool = False
    """only the ceiling: no splat is drawn and no device opened"""

    @property
    def marker_count(self) -> int:
        """Markers of each category."""
        return (1 if self.quick else MARKERS) if self.markers is None else self.markers

    @property
    def methods(self) -> tuple[str, ...]:
        """Rows of the tables."""
        return (IDEAL,) if self.ideal_only else method_names(self.mixtures, self.trained)

    def file(self, name: str) -> Path:
        """Where the results of an experiment go."""
        ending = "" if self.part is None else "-" + self.part.replace("/", "-of-")
        return self.out / f"{name}{ending}.jsonl"

    @property
    def blender_folder(self) -> Path:
        """Where Blender's pictures are."""
        return self.out / "blender" if self.blender is None else self.blender


@dataclass(frozen=True, eq=False)
class Plan:
    """An experiment that is ready to run."""

    records: Records
    work: list[dict]
    measure: Callable[[dict], dict]

    def run(self) -> Iterator[tuple[int, dict]]:
        """Measure what is missing; yields (parts done, line)."""
        return self.records.measure(self.work, self.measure)

    @property
    def left(self) -> int:
        """Parts that are still to be measured."""
        return self.records.missing(self.work)


@contextmanager
def planned(names: Iterable[str], settings: Settings) -> Iterator[dict[str, Plan]]:
    """Experiments by name with all that they need, opened for as long as the context lasts.

    All are made ready before the first runs: what is wrong with the last is not told after hours.

    Raises InputError for settings that cannot be used, DeviceError when the device cannot be opened.
    """
    check(settings)
    works = {name: shard(_work(name, settings), settings.part) for name in names}
    writable_folder(settings.out)
    draws = not settings.ideal_only and any(name != counts.NAME for name in works)
    renderer = Renderer(settings.device) if draws else None
    painter = Painter(renderer, settings.trained)
    pool = ThreadPoolExecutor(settings.workers)
    try:
        # first, for it reads files: --anew drops nothing for a run that cannot begin
        measures = {name: _measure(name, settings, painter, pool) for name in works}
        yield {
            name: Plan(_records(name, settings, renderer), work, measures[name])
            for name, work in works.items()
        }
    finally:
        # an interrupt must not wait for pictures that nobody will look at
        pool.shutdown(cancel_futures=True)


def _records(name: str, settings: Settings, renderer: Renderer | None) -> Records:
    device = None
    if renderer is not None and name != counts.NAME:
        device = f"{renderer.device.title}, {renderer.device.version}"
    versions = reader_versions() | (metric_versions() if name == views.NAME else {})
    return Records(settings.file(name), run_facts(device, settings.seed, versions), settings.anew)


def check(settings: Settings) -> None:
    """Raises InputError for settings that cannot be used."""
    chosen_categories(settings.categories)
    for name in settings.protocols:
        if name not in PROTOCOLS:
            raise InputError(f"unknown protocol {name!r}; known: {', '.join(PROTOCOLS)}")
    if not 1 <= settings.marker_count <= MARKERS:
        raise InputError(f"--markers is {settings.markers}; each category has 1 to {MARKERS}")
    if settings.workers < 1:
        raise InputError(f"--workers is {settings.workers}; at least 1 thread looks at pictures")
    _check_trained(settings)
    if settings.blender is not None and not settings.blender.is_dir():
        raise InputError(
            f"{settings.blender} is not a folder; give the one that fidsplat experiment blender wrote"
        )
    for view in VIEW_NAMES:
        check_pictures(settings.blender_folder, view, settings.seed)
    if settings.tilts is not None:
        angles.parse_tilts(settings.tilts)
    method_names(settings.mixtures)


def _check_trained(settings: Settings) -> None:
    folder = settings.trained
    if folder is None or settings.ideal_only:
        return
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give one with 2dgs-17/small-0.ply and the like")
    models = [method for method in settings.methods if method.startswith("2dgs-")]
    if not models:
        raise InputError(f"{folder} holds none of 2dgs-3, 2dgs-5, 2dgs-9 and 2dgs-17")
    for model in models:
        for category in chosen_categories(settings.categories):
            for index in range(settings.marker_count):
                file = folder / model / f"{category.name}-{index}.ply"
                if not file.is_file():
                    raise InputError(
                        f"{file} is missing; --category and --markers leave out what was not trained"
                    )


def _work(name: str, settings: Settings) -> list[dict]:
    categories, count = chosen_categories(settings.categories), settings.marker_count
    if name == counts.NAME:
        repeats = counts.QUICK_REPEATS if settings.quick else counts.FULL_REPEATS
        # all five cost a second
        return counts.counts_work(categories, repeats, MARKERS if settings.markers is None else count)
    if name == localisation.NAME:
        located = tuple(c for c in categories if c.name in localisation.LOCATED)
        spans = (localisation.DISTANCES, localisation.TILTS)
        if settings.quick:
            spans = (localisation.QUICK_DISTANCES, localisation.QUICK_TILTS)
        return localisation.localisation_work(located, settings.methods, *spans, count)
    if name == views.NAME:
        number = QUICK_VIEWS if settings.quick else TEST_VIEWS
        weights = None if settings.lpips is None else weights_name(settings.lpips)
        return views.views_work(categories, settings.methods, settings.blender_folder, count, number, weights)
    tilts = settings.tilts or (angles.QUICK_TILTS if settings.quick else angles.FULL_TILTS)
    return angles.angles_work(
        categories, settings.protocols or tuple(PROTOCOLS), settings.methods, tilts, count
    )


def _measure(
    name: str, settings: Settings, painter: Painter, pool: ThreadPoolExecutor
) -> Callable[[dict], dict]:
    seed = settings.seed
    if name == counts.NAME:
        return lambda part: counts.measure_counts(part, seed)
    if name == localisation.NAME:
        return lambda part: localisation.measure_localisation(part, painter, seed, pool)
    if name == views.NAME:
        perceptual = None if settings.lpips is None else load_lpips(settings.lpips)
        kept = views.Kept()
        return lambda part: views.measure_views(
            part, painter, seed, settings.blender_folder, pool, perceptual, kept
        )
    return lambda part: angles.measure_angles(part, painter, seed, pool, settings.workers)
