"""The paper's baseline: 2DGS trained on 3, 5, 9 and 17 views of each marker (`experiment views --trained` and
`angles --trained` then draw and read what was trained)."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fidsplat.experiments.dataset import write_scene
from fidsplat.experiments.sweep import Key
from fidsplat.files import writable_folder
from fidsplat.render import Renderer
from fidsplat.train import Step, Trainer, TrainSettings, load_dataset

NAME = "trained"


def train_marker(
    point: Key,
    folder: Path,
    out: Path,
    settings: TrainSettings,
    renderer: Renderer,
    tell: Callable[[Step], None] | None = None,
) -> dict:
    """Train one marker on one collection of views, and write its splats as `Painter` finds them.

    A training that was stopped goes on from its checkpoint, which goes when the splats are written.

    Args:
        point: of `fidsplat.experiments.dataset.dataset_scenes`.
        folder: of the data set; the scene is written where it is missing, with the ideal pictures.
        out: gets 2dgs-17/small-0.ply and the like.
        settings: of the training; its seed is that of the marker's text too.

    Returns:
        `splats`, `seconds` of the training, `iterations` that these took, and of the views held out the means
        `psnr` [dB] and `ssim` over their colours.

    Raises:
        InputError: the scene cannot be written or read, or a checkpoint is of another run.
    """
    scene = write_scene(point, folder, settings.seed, "exact", Path())
    place = writable_folder(out / f"2dgs-{point['views']}")
    file = place / f"{point['category']}-{point['index']}.ply"
    checkpoint = file.with_suffix(".training.npz")
    trainer = Trainer(load_dataset(scene), renderer, settings, checkpoint)
    begun, before = time.perf_counter(), trainer.iteration
    trainer.run(tell)
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
