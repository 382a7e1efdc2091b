"""--ray ADDRESS: the options of commands whose work the machines of a cluster do."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from fidsplat.commands.output import counted, option
from fidsplat.commands.sweeps import words
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.settings import ImageSettings

RayAddress = Annotated[
    str | None,
    option(
        "ADDRESS", "let a Ray cluster do it: local, auto, ray://HOST:10001 (extra: ray; docs/command-line.md)"
    ),
]
Workers = Annotated[
    int | None, option("N", "of --ray (default: one for each GPU, or for each machine without any)")
]


def check_workers(ray: str | None, workers: int | None) -> None:
    """Raises InputError for a number of workers that cannot be, before anything is read."""
    if workers is not None and (ray is None or workers < 1):
        raise InputError(f"--workers is {workers}; give at least 1, and --ray ADDRESS")


def measure_by(ray: str, names: tuple[str, ...], options: ImageSettings) -> dict[str, str]:
    """Let a cluster measure experiments; returns the files of their results."""
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
        list(counted("", measured, total, total - left, lambda pair: f"{pair[0]} {words(pair[1].key)}"))
    return {name: str(results[name].file) for name in names if points[name]}
