"""The paper's experiments as sweeps: points and results file of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from functools import partial
from itertools import product
from typing import Any

from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.methods import IDEAL, MarkerRenderer
from fidsplat.experiments.settings import ImageSettings, MeasureSettings, ShardSettings
from fidsplat.experiments.setup import MARKERS, PROTOCOLS, TEST_VIEWS, Category, chosen_categories
from fidsplat.experiments.sweep import Key, Results, Sweep, shard, thread_pool
from fidsplat.render.renderer import Renderer
from fidsplat.util.files import writable_folder
from fidsplat.util.provenance import run_facts
from fidsplat.vision.metrics import load_lpips, metric_versions
from fidsplat.vision.readers import reader_versions

NAMES = (counts.NAME, localisation.NAME, views.NAME, angles.NAME)
"""measuring experiments, starting with the fastest"""
QUICK_VIEWS = 1


@contextmanager
def prepared(names: Iterable[str], options: MeasureSettings) -> Iterator[list[Sweep]]:
    """Sweeps of experiments by name.

    All sweeps are prepared before the first one runs, so that errors are reported immediately.

    Raises InputError for invalid options, DeviceError if the device cannot be opened.
    """
    options.check()
    points = {name: points_of(name, options) for name in names}
    writable_folder(options.folder)
    renderer, markers, workers = None, MarkerRenderer(None), 1
    if isinstance(options, ImageSettings):
        if options.methods != (IDEAL,) and any(name != counts.NAME for name in points):
            renderer = Renderer(options.device)
        markers, workers = MarkerRenderer(renderer, options.trained), options.workers
    device = None if renderer is None else device_name(renderer)
    with thread_pool(workers) as pool:
        # before `results_of`, so that --overwrite deletes no results if the measurement cannot start
        measures = {name: _measure(name, options, markers, pool) for name in points}
        yield [
            Sweep(
                name,
                results_of(name, options, device if name != counts.NAME else None),
                points[name],
                partial(partial, measures[name]),
            )
            for name in points
        ]


def device_name(renderer: Renderer) -> str:
    """Title and driver of a device, for the facts of a run."""
    return f"{renderer.device.title}, {renderer.device.version}"


def results_of(name: str, options: ShardSettings, device: str | None) -> Results:
    """Results file of an experiment. device: `device_name` of the renderer, or None."""
    versions = reader_versions() | (metric_versions() if name == views.NAME else {})
    return Results(options.file(name), run_facts(device, options.seed, versions), options.overwrite)


def points_of(name: str, options: MeasureSettings) -> list[Key]:
    """Points of an experiment, restricted to the shard of the run."""
    return shard(_points(name, options), options.shard)


def _points(name: str, options: Any) -> list[Key]:
    categories, count = chosen_categories(options.category), options.marker_count
    if name == counts.NAME:
        repeats = counts.QUICK_REPEATS if options.quick else counts.FULL_REPEATS
        count = MARKERS if options.markers is None else count  # also in a quick run: it takes a second
        return [{**marker, "repeats": repeats} for marker in _markers(categories, count)]
    if name == views.NAME:
        number = QUICK_VIEWS if options.quick else TEST_VIEWS
        folder = options.blender_folder
        return views.views_points(categories, options.methods, folder, count, number, options.lpips)
    if name == localisation.NAME:
        distances, tilts = localisation.QUICK if options.quick else localisation.FULL
        located = _markers((c for c in categories if c.name in localisation.LOCATED), count)
        spans = {"distances": list(distances), "tilts": list(tilts)}
        return [{**marker, "method": m, **spans} for marker, m in product(located, options.methods)]
    tilts = options.tilts or (angles.QUICK_TILTS if options.quick else angles.FULL_TILTS)
    scans = product(_markers(categories, count), options.methods)
    scans_of_markers = [{**marker, "method": m, "tilts": tilts} for marker, m in scans]
    return [{"protocol": p, **marker} for p in options.protocol or PROTOCOLS for marker in scans_of_markers]


def _markers(categories: Iterable[Category], count: int) -> list[Key]:
    return [{"category": c.name, "index": i} for c in categories for i in range(count)]


def _measure(name: str, options: Any, markers: MarkerRenderer, pool: Executor) -> Callable[[Key], dict]:
    if name == counts.NAME:
        return partial(counts.measure_counts, seed=options.seed)
    common = {"markers": markers, "seed": options.seed, "pool": pool}
    if name == localisation.NAME:
        return partial(localisation.measure_localisation, **common)
    if name == views.NAME:
        lpips = load_lpips() if options.lpips else None
        return partial(views.measure_views, blender=options.blender_folder, lpips=lpips, **common)
    return partial(angles.measure_angles, workers=options.workers, **common)
