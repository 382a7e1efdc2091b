"""Figure of counts and table 2: components, rectangles, Gaussians and seconds of each marker."""

from __future__ import annotations

import numpy as np

from fidsplat.experiments.methods import mixtures
from fidsplat.experiments.plane import runs
from fidsplat.experiments.setup import CATEGORIES
from fidsplat.markers import marker
from fidsplat.markers.mixture import fitted_templates, paper_template, place

NAME = "counts"
FULL_REPEATS, QUICK_REPEATS = 15, 3


def measure_counts(point: dict, seed: int) -> dict:
    """Sizes of a marker and times of its construction.

    Returns the numbers of dark and of light (quiet zone included) `cells`, `runs` (of one colour in a row),
    `rectangles` (minimum partition) and `components`; `gaussians` by mixture and partition; and `seconds` by
    mixture: times from text to splats after a warm-up, one for each repeat.
    """
    spec = CATEGORIES[point["category"]].spec(point["index"], seed)
    plain = marker(spec)
    grid = plain.grid
    y, x0, x1, _ = runs(grid)
    by_runs = np.stack([x0, y, x1, y + 1], 1)
    boxes = {"cells": _cells(grid), "runs": by_runs, "rectangles": plain.boxes}
    result: dict = {name: _by_color(grid, found) for name, found in boxes.items()}
    first = np.zeros(plain.components, int)
    first[plain.labels.ravel()] = grid.ravel()
    result["components"] = {"dark": int(first.sum()), "light": int(plain.components - first.sum())}
    result["gaussians"], result["seconds"] = {}, {}
    for mixture in mixtures():
        repeats = [marker(spec, mixture=mixture) for _ in range(1 + point["repeats"])]
        result["seconds"][mixture] = [repeat.seconds for repeat in repeats[1:]]
        result["gaussians"][mixture] = {"rectangles": len(repeats[0].cloud)} | {
            name: count
            for name in ("cells", "runs")
            if (count := _gaussians(mixture, boxes[name])) is not None
        }
    return result


def _cells(grid: np.ndarray) -> np.ndarray:
    y, x = np.indices(grid.shape).reshape(2, -1)
    return np.stack([x, y, x + 1, y + 1], 1)


def _by_color(grid: np.ndarray, boxes: np.ndarray) -> dict[str, int]:
    dark = int(grid[boxes[:, 1], boxes[:, 0]].sum())
    return {"dark": dark, "light": len(boxes) - dark}


def _gaussians(mixture: str, boxes: np.ndarray) -> int | None:
    """Number of Gaussians of a mixture for these rectangles; None for mixtures that are made from modules."""
    if mixture == "exact":
        return len(boxes)
    if mixture == "paper":
        return len(boxes) * len(paper_template())
    if mixture != "fitted":
        return None
    sides = boxes[:, 2:] - boxes[:, :2]
    return len(place(boxes.astype(np.float64), sides[:, 0] / sides[:, 1], fitted_templates())[1])
