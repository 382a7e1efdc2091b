"""Report of a training run: curves, held-out views, settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fidsplat.experiments.charts import COLORS, chart
from fidsplat.experiments.pages import fixed, page_and_folder, write_page
from fidsplat.images.files import write_png
from fidsplat.train import Trainer, TrainingView, ViewScore
from fidsplat.util.provenance import run_facts

MAX_VIEWS = 4
"""maximum number of images of held-out views"""
_POINTS = 200
"""points per curve, each the mean of an equal part of the run"""


def write_training_page(
    trainer: Trainer, scores: Sequence[ViewScore], facts: Mapping[str, Any], out: Path
) -> list[Path]:
    """Write the report, its chart and images; returns the files, starting with the report.

    facts: output of `fidsplat train --json`.

    Raises InputError if a file cannot be written.
    """
    page, folder = page_and_folder(out, "training.md.j2")
    files = [page, folder / "training.svg"]
    draw_curves(trainer.history, files[1])
    shown = []
    rows = np.unique(np.linspace(0, len(scores) - 1, min(MAX_VIEWS, len(scores))).astype(int))
    for row in rows if len(scores) else ():
        name = f"held-out-{len(shown)}.png"
        files.append(write_png(folder / name, side_by_side(trainer.dataset.held_out[row], scores[row])))
        shown.append({"name": scores[row].name, "file": name})
    table = [
        {"view": score.name, "PSNR, dB": fixed(score.psnr, 2), "SSIM": fixed(score.ssim, 4)}
        for score in scores
    ]
    if scores:
        table.append({"view": "mean", "PSNR, dB": fixed(facts["psnr"], 2), "SSIM": fixed(facts["ssim"], 4)})
    settings = asdict(trainer.settings).items()
    context = {
        "facts": facts,
        "scores": pd.DataFrame(table),
        "images": shown,
        "settings": pd.DataFrame([{"setting": name, "value": value} for name, value in settings]),
        "run": run_facts(trainer.renderer.device.title, trainer.settings.seed),
    }
    write_page(page, folder, "training.md.j2", context)
    return files


def draw_curves(history: Mapping[str, np.ndarray], file: Path) -> None:
    """Write charts of loss, training PSNR and number of splats over the iterations."""
    panels = (("losses", "loss"), ("psnrs", "PSNR of the view, dB"), ("counts", "splats"))
    with chart(file, panels=len(panels), size=(9.0, 3.0), one_scale=False) as (_, axes):
        for (name, title), axis, color in zip(panels, axes, COLORS[1:], strict=False):
            axis.plot(*_means(history[name]), color=color)
            axis.set(title=title, xlabel="iteration")


def side_by_side(view: TrainingView, score: ViewScore) -> np.ndarray:
    """Ground truth, rendered image, and their difference times four around grey, side by side."""
    difference = 4 * (score.image.astype(float) - view.image) + 128
    return np.hstack([view.image, score.image, np.clip(difference, 0, 255).astype(np.uint8)])


def _means(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres and means of equal parts of a curve, without infinite values."""
    parts = [part for part in np.array_split(np.arange(len(values)), _POINTS) if len(part)]
    finite = [values[part][np.isfinite(values[part])] for part in parts]
    means = [float(np.mean(part)) if len(part) else np.nan for part in finite]
    return np.array([part.mean() + 1 for part in parts]), np.array(means)
