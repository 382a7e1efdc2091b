"""The paper's experiments, measured point by point by workers."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from fidsplat.experiments import counts
from fidsplat.experiments.methods import IDEAL
from fidsplat.experiments.run import device_name, prepared
from fidsplat.experiments.settings import ImageSettings, ViewSettings
from fidsplat.experiments.sweep import Key, Record, Results
from fidsplat.remote.queue import Engine, drain
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import FidsplatError, InputError


@dataclass(frozen=True)
class ExperimentWork:
    """Data that a worker needs to measure points of experiments; a call opens the device.

    Raises InputError for settings that name files of this machine, and for measurements of time.
    """

    names: tuple[str, ...]
    options: ImageSettings

    def __post_init__(self) -> None:
        options = self.options
        options.check()
        if counts.NAME in self.names:
            raise InputError(
                "experiments with --ray must be independent of the machine, got counts, which times one idle "
                "machine; run it without --ray"
            )
        local = [options.trained]
        if isinstance(options, ViewSettings):
            local += [options.lpips, options.blender_folder if options.blender_folder.exists() else None]
        for path in local:
            if path is not None:
                raise InputError(
                    f"{path} is on the disk of this machine, which workers do not share; run it without "
                    "--ray, for example by --shard"
                )

    def __call__(self) -> ExperimentWorker:
        return ExperimentWorker(self)


class ExperimentWorker:
    """Measures points of experiments by their indices."""

    def __init__(self, work: ExperimentWork) -> None:
        self._open = ExitStack()
        folder = self._open.enter_context(tempfile.TemporaryDirectory())
        options = replace(work.options, out=Path(folder))
        self._sweeps = {s.name: s for s in self._open.enter_context(prepared(work.names, options))}
        self.title = "" if options.methods == (IDEAL,) else device_name(Renderer(options.device))

    def __call__(self, item: tuple[str, int]) -> dict:
        """The result of a point, by the experiment's name and the point's index."""
        name, number = item
        sweep = self._sweeps[name]
        return sweep.begin(sweep.points[number])()


def measure(
    points: Mapping[str, list[Key]], results: Mapping[str, Results], engine: Engine, workers: int
) -> Iterator[tuple[str, Record]]:
    """Measure the missing points of experiments on workers. Writes each record to its result file, then
    yields the name of the experiment and the record. Raises FidsplatError like `drain`.

    Args:
        points, results: points and result files by the name of the experiment.
    """
    for result in results.values():
        result.run["machine"] = f"a Ray cluster, {workers} workers"
    left = [(name, points[name].index(key)) for name in points for key in results[name].left(points[name])]
    for (name, number), result in drain(engine, left, workers):
        try:
            if not isinstance(result, dict):
                raise TypeError(f"{type(result).__name__}")
            record = results[name].append(points[name][number], result)
        except (TypeError, ValueError, RecursionError) as error:
            raise FidsplatError(
                f"the reply of a worker must be a result of {name} that JSON can hold, got {error}; install "
                "the same fidsplat there"
            ) from error
        yield name, record
