"""Sweeps of measurements with progress bars, on this machine or on a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

from fidsplat.commands.output import show_progress

if TYPE_CHECKING:
    from fidsplat.experiments.settings import ImageSettings
    from fidsplat.experiments.sweep import Key, Record, Sweep


def run_sweeps(sweeps: Iterable[Sweep]) -> list[Record]:
    """Measure the missing points of each sweep in turn; returns their records."""
    return [record for sweep in sweeps for record in _with_progress(sweep.name, [sweep], sweep.run())]


def run_interleaved(name: str, sweeps: Sequence[Sweep]) -> list[Record]:
    """Measure the missing points of all sweeps round robin, with one progress bar; returns their records."""
    from fidsplat.experiments.sweep import run_interleaved as measure

    return list(_with_progress(name, sweeps, measure(sweeps)))


def _with_progress(name: str, sweeps: Sequence[Sweep], records: Iterable[Record]) -> Iterator[Record]:
    total, left = sum(len(sweep.points) for sweep in sweeps), sum(len(sweep.left) for sweep in sweeps)
    return show_progress(name, records, total, total - left, lambda record: point_label(record.key))


def point_label(key: Key) -> str:
    """Names of a point, without numbers and settings."""
    return " ".join(value for value in key.values() if isinstance(value, str))


def measure_on_cluster(ray: str, names: tuple[str, ...], options: ImageSettings) -> dict[str, str]:
    """Measure experiments on a Ray cluster; returns the files of their results."""
    from fidsplat.experiments.run import points_of, results_of
    from fidsplat.remote.experiments import ExperimentWork, measure
    from fidsplat.remote.ray_engine import ray_engine

    work = ExperimentWork(names, options)
    with ray_engine(ray, work) as engine:
        device = engine.title or None
        results = {name: results_of(name, options, device) for name in names}
        points = {name: points_of(name, options) for name in names}
        total = sum(len(each) for each in points.values())
        left = sum(len(results[name].left(points[name])) for name in names)
        measured = measure(points, results, engine, engine.workers)
        list(
            show_progress(
                "", measured, total, total - left, lambda pair: f"{pair[0]} {point_label(pair[1].key)}"
            )
        )
    return {name: str(results[name].file) for name in names if points[name]}
