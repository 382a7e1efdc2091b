"""The paper's experiments as sweeps: the points of each, with which options, and where its results go."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.blender import VIEW_NAMES, check_pictures
from fidsplat.experiments.methods import IDEAL, Painter, method_names
from fidsplat.experiments.setup import MARKERS, PROTOCOLS, SEED, TEST_VIEWS, chosen_categories
from fidsplat.experiments.sweep import Key, Results, Sweep
from fidsplat.experiments.sweep import shard as share_of
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_folder
from fidsplat.util.provenance import run_facts
from fidsplat.vision.metrics import load_lpips, metric_versions, weights_name
from fidsplat.vision.readers import reader_versions

NAMES = (counts.NAME, localisation.NAME, views.NAME, angles.NAME)
"""the experiments that measure, quickest first"""
QUICK_VIEWS = 1


@dataclass(frozen=True)
class Part:
    """Which markers a run takes, and where its results go, by the names that the command line has for it."""

    out: Path
    seed: int = SEED
    """of texts and views"""
    category: tuple[str, ...] = ()
    markers: int | None = None
    """of each category; None for 5, or 1 in a quick run"""
    shard: str | None = None
    """"i/n\""""
    workers: int = field(default_factory=lambda: os.cpu_count() or 1)
    """threads that look at pictures"""
    overwrite: bool = False

    def file(self, name: str) -> Path:
        """Where the results of an experiment go."""
        ending = "" if self.shard is None else "-" + self.shard.replace("/", "-of-")
        return self.out / f"{name}{ending}.jsonl"

    @property
    def marker_count(self) -> int:
        """Markers of each category."""
        return MARKERS if self.markers is None else self.markers

    def check(self) -> None:
        """Raises InputError for an unknown category, or numbers that cannot be."""
        chosen_categories(self.category)
        if not 1 <= self.marker_count <= MARKERS:
            raise InputError(f"--markers is {self.markers}; each category has 1 to {MARKERS}")
        if self.workers < 1:
            raise InputError(f"--workers is {self.workers}; at least 1 thread looks at pictures")


@dataclass(frozen=True)
class Options(Part):
    """What a run of the experiments is to measure."""

    device: str = "opencl"
    quick: bool = False
    """one marker of each category, few tilts and views"""
    mixture: tuple[str, ...] = ()
    protocol: tuple[str, ...] = ()
    tilts: str | None = None
    trained: Path | None = None
    """folder with trained models, see `Painter`"""
    blender: Path | None = None
    """folder with Blender's pictures; None for "blender" in ``out``"""
    lpips: Path | None = None
    """file with LPIPS weights, see `fidsplat.vision.metrics.load_lpips`"""
    ideal: bool = False
    """only the ceiling: no splat is drawn and no device opened"""

    @property
    def marker_count(self) -> int:
        """Markers of each category."""
        return 1 if self.quick and self.markers is None else super().marker_count

    @property
    def methods(self) -> tuple[str, ...]:
        """Rows of the tables."""
        return (IDEAL,) if self.ideal else method_names(self.mixture, self.trained)

    @property
    def blender_folder(self) -> Path:
        """Where Blender's pictures are."""
        return self.out / "blender" if self.blender is None else self.blender


@contextmanager
def prepared(names: Iterable[str], options: Options) -> Iterator[list[Sweep]]:
    """Experiments by name with all that they need, opened for as long as the context lasts.

    All are made ready before the first runs: what is wrong with the last shows before hours have gone.

    Raises InputError for options that cannot be used, DeviceError when the device cannot be opened.
    """
    check(options)
    points = {name: points_of(name, options) for name in names}
    writable_folder(options.out)
    draws = not options.ideal and any(name != counts.NAME for name in points)
    renderer = Renderer(options.device) if draws else None
    device = None if renderer is None else device_words(renderer)
    painter = Painter(renderer, options.trained)
    pool = ThreadPoolExecutor(options.workers)
    try:
        # first, for it reads files: --overwrite drops nothing for a run that cannot begin
        measures = {name: _measure(name, options, painter, pool) for name in points}
        yield [
            Sweep(
                name,
                results_of(name, options, device if name != counts.NAME else None),
                points[name],
                partial(partial, measures[name]),
            )
            for name in points
        ]
    finally:
        # an interrupt must not wait for pictures that nobody will look at
        pool.shutdown(cancel_futures=True)


def device_words(renderer: Renderer) -> str:
    """A device in the facts of a run: title and driver."""
    return f"{renderer.device.title}, {renderer.device.version}"


def results_of(name: str, options: Part, device: str | None) -> Results:
    """The file of an experiment's results; device: `device_words` of what draws, None where nothing does."""
    versions = reader_versions() | (metric_versions() if name == views.NAME else {})
    return Results(options.file(name), run_facts(device, options.seed, versions), options.overwrite)


def check(options: Options) -> None:
    """Raises InputError for options that cannot be used."""
    options.check()
    for name in options.protocol:
        if name not in PROTOCOLS:
            raise InputError(f"unknown protocol {name!r}; known: {', '.join(PROTOCOLS)}")
    _check_trained(options)
    if options.blender is not None and not options.blender.is_dir():
        raise InputError(
            f"{options.blender} is not a folder; give the one that fidsplat experiment blender wrote"
        )
    for view in VIEW_NAMES:
        check_pictures(options.blender_folder, view, options.seed)
    if options.tilts is not None:
        angles.parse_tilts(options.tilts)
    method_names(options.mixture)


def _check_trained(options: Options) -> None:
    folder = options.trained
    if folder is None or options.ideal:
        return
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; give one with 2dgs-17/small-0.ply and the like")
    models = [method for method in options.methods if method.startswith("2dgs-")]
    if not models:
        raise InputError(f"{folder} holds none of 2dgs-3, 2dgs-5, 2dgs-9 and 2dgs-17")
    for model in models:
        for category in chosen_categories(options.category):
            for index in range(options.marker_count):
                file = folder / model / f"{category.name}-{index}.ply"
                if not file.is_file():
                    raise InputError(
                        f"{file} is missing; --category and --markers leave out what was not trained"
                    )


def points_of(name: str, options: Options) -> list[Key]:
    """The points of an experiment, or a run's share of them."""
    return share_of(_points(name, options), options.shard)


def _points(name: str, options: Options) -> list[Key]:
    categories, count = chosen_categories(options.category), options.marker_count
    if name == counts.NAME:
        repeats = counts.QUICK_REPEATS if options.quick else counts.FULL_REPEATS
        # all five cost a second
        return counts.counts_points(categories, repeats, MARKERS if options.markers is None else count)
    if name == localisation.NAME:
        located = tuple(c for c in categories if c.name in localisation.LOCATED)
        spans = (localisation.DISTANCES, localisation.TILTS)
        if options.quick:
            spans = (localisation.QUICK_DISTANCES, localisation.QUICK_TILTS)
        return localisation.localisation_points(located, options.methods, *spans, count)
    if name == views.NAME:
        number = QUICK_VIEWS if options.quick else TEST_VIEWS
        weights = None if options.lpips is None else weights_name(options.lpips)
        return views.views_points(categories, options.methods, options.blender_folder, count, number, weights)
    tilts = options.tilts or (angles.QUICK_TILTS if options.quick else angles.FULL_TILTS)
    return angles.angles_points(
        categories, options.protocol or tuple(PROTOCOLS), options.methods, tilts, count
    )


def _measure(
    name: str, options: Options, painter: Painter, pool: ThreadPoolExecutor
) -> Callable[[Key], dict]:
    seed = options.seed
    if name == counts.NAME:
        return lambda part: counts.measure_counts(part, seed)
    if name == localisation.NAME:
        return lambda part: localisation.measure_localisation(part, painter, seed, pool)
    if name == views.NAME:
        perceptual = None if options.lpips is None else load_lpips(options.lpips)
        kept = views.Kept()
        return lambda part: views.measure_views(
            part, painter, seed, options.blender_folder, pool, perceptual, kept
        )
    return lambda part: angles.measure_angles(part, painter, seed, pool, options.workers)
