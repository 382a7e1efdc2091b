"""Baseline of the paper: 2DGS trained on 3, 5, 9 and 17 views of each marker.

Models are evaluated on novel views (table 4) and by the largest readable tilt (table 3).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from fidsplat.experiments import angles, views
from fidsplat.experiments.dataset import write_scene
from fidsplat.experiments.methods import MarkerRenderer
from fidsplat.experiments.run import device_name, results_of
from fidsplat.experiments.settings import SweepSettings
from fidsplat.experiments.setup import COLLECTIONS, TEST_VIEWS, chosen_categories
from fidsplat.experiments.sweep import Key, Sweep, shard, thread_pool
from fidsplat.render.renderer import Renderer
from fidsplat.train import Step, Trainer, TrainSettings, load_dataset
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_folder
from fidsplat.vision.metrics import has_flip

NAME = "trained"
_TILTS = "0:40:5,40.2:89.8:0.2"
"""tilts of the scans, dense near the limit of reading"""


@dataclass(frozen=True)
class BaselineSettings(SweepSettings):
    """Settings of the baseline's trainings."""

    out: Path | None = None
    """Folder for splats and results. By default fidsplat-baseline."""
    dataset: Path = Path("fidsplat-dataset")
    """Folder that `fidsplat experiment dataset` wrote; missing scenes are written into it."""
    views: tuple[int, ...] = ()
    """Number of training views: 3, 5, 9 or 17. By default all; repeat for several."""
    iterations: int = 7000
    """Iterations of each training."""
    seeds: int = 1
    """Number of trainings per marker and number of views, each with its own random numbers. The detectors
    evaluate the first."""
    workers: int = 2
    """Number of threads that evaluate images."""

    @property
    def folder(self) -> Path:
        return self.out or Path("fidsplat-baseline")

    def check(self) -> None:
        super().check()
        for number in self.views:
            if number not in COLLECTIONS:
                raise InputError(f"--views must be {', '.join(map(str, COLLECTIONS))}, got {number}")
        if self.seeds < 1:
            raise InputError(f"--seeds must be at least 1, got {self.seeds}")
        if self.workers < 1:
            raise InputError(f"--workers must be at least 1 thread, got {self.workers}")
        TrainSettings(iterations=self.iterations)

    @property
    def points(self) -> list[Key]:
        """Points of the trainings, one marker of each category first."""
        points = [
            {
                **{"category": category.name, "index": index, "views": number},
                **{"iterations": self.iterations, "seed": seed},
            }
            for seed in range(self.seeds)
            for index in range(self.marker_count)
            for category in chosen_categories(self.category)
            for number in self.views or COLLECTIONS
        ]
        return shard(points, self.shard)


@contextmanager
def baseline_sweeps(settings: BaselineSettings, renderer: Renderer) -> Iterator[list[Sweep]]:
    """Sweeps of the trainings, and of the views and angles of the first seed, to run interleaved.

    Thus an interrupted run has evaluated its trained models.

    Raises InputError if files cannot be written, or hold results of another device, version, code, seed or
    number of iterations.
    """
    folder, markers = writable_folder(settings.folder), MarkerRenderer(renderer, settings.folder)
    device = device_name(renderer)
    trainings = results_of(NAME, settings, device)
    if other := {record.key["iterations"] for record in trainings.done.values()} - {settings.iterations}:
        # results of views and angles do not name the number of iterations
        raise InputError(
            f"{trainings.file} holds trainings of {min(other)} iterations, not {settings.iterations}; give "
            "another folder with -o, or --overwrite to train again"
        )
    train = partial(
        train_marker,
        folder=settings.dataset,
        out=folder,
        texts=settings.seed,
        renderer=renderer,
        restart=settings.overwrite,
    )
    with thread_pool(settings.workers) as pool:
        common = {"markers": markers, "seed": settings.seed, "pool": pool}
        view = partial(views.measure_views, blender=Path(), cache=views.ImageCache(), **common)
        scan = partial(angles.measure_angles, workers=settings.workers, **common)
        first = [
            {"category": p["category"], "index": p["index"], "method": f"2dgs-{p['views']}"}
            for p in settings.points
            if p["seed"] == 0
        ]
        viewed = {"truth": "exact", "views": TEST_VIEWS, "flip": has_flip(), "lpips": None}
        yield [
            Sweep(name, results, points, partial(partial, measure))
            for name, results, points, measure in (
                (NAME, trainings, settings.points, train),
                (views.NAME, results_of(views.NAME, settings, device), [p | viewed for p in first], view),
                (
                    angles.NAME,
                    results_of(angles.NAME, settings, device),
                    [{"protocol": "fixed-plane"} | p | {"tilts": _TILTS} for p in first],
                    scan,
                ),
            )
        ]


def model_file(out: Path, point: Key) -> Path:
    """File of the splats of a training."""
    folder = out if point["seed"] == 0 else out / f"seed-{point['seed']}"
    return folder / f"2dgs-{point['views']}" / f"{point['category']}-{point['index']}.ply"


def train_marker(
    point: Key,
    folder: Path,
    out: Path,
    texts: int,
    renderer: Renderer,
    progress: Callable[[Step], None] | None = None,
    restart: bool = False,
) -> dict:
    """Train a marker on a collection of views and write its splats.

    An interrupted training resumes from its checkpoint, which is deleted at the end.

    Args:
        point: a point of `BaselineSettings.points`.
        folder: folder of the data set; a missing scene is written, with the ideal images.
        out: folder for models, such as 2dgs-17/small-0.ply, or seed-1/2dgs-17/small-0.ply.
        texts: seed of the marker's text and views.
        restart: ignore a checkpoint.

    Returns:
        `splats`, `seconds` and `iterations` of this run, and the means `psnr` [dB] and `ssim` of the held-out
        views.

    Raises:
        InputError: the scene cannot be written or read, or a checkpoint is from another run.
    """
    scene = write_scene(point, folder, texts, "exact", Path())
    file = model_file(out, point)
    writable_folder(file.parent)
    settings = TrainSettings(iterations=point["iterations"], seed=point["seed"])
    checkpoint = file.with_suffix(".training.npz")
    trainer = Trainer(load_dataset(scene), renderer, settings, checkpoint, restart=restart)
    begun, before = time.perf_counter(), trainer.iteration
    trainer.run(progress, prompt=False)
    seconds = time.perf_counter() - begun
    trainer.save(file)
    scores = trainer.evaluate()
    checkpoint.unlink(missing_ok=True)
    return {
        "splats": len(trainer.cloud()),
        "seconds": seconds,
        "iterations": trainer.iteration - before,
        "psnr": float(np.mean([score.psnr for score in scores])),
        "ssim": float(np.mean([score.ssim for score in scores])),
    }
