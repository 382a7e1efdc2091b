"""Splats as samples of a Markov chain (Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte
Carlo", 2024): dead splats move to live ones, as many new ones come as are allowed, and all are shaken.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np

from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.train.densify import forgotten
from fidsplat.train.parameters import NAMES, Splats, TrainingError, sigmoid
from fidsplat.train.random_numbers import Purpose, normal, uniform
from fidsplat.train.settings import TrainSettings

MOST_COPIES = 51
"""copies of a splat that the formula for their opacity and scale counts, at most"""
STEEP, CLEAR = 100.0, 0.995
"""of the sigmoid by which opaque splats are shaken less"""


def moved(splats: Splats, settings: TrainSettings, iteration: int) -> Splats:
    """The splats after the dead ones went to live ones and new ones came, in place of what they stand beside:
    together they look as the one did.

    Raises:
        TrainingError: every splat is dead.
    """
    opacities = splats.opacities
    dead = np.flatnonzero(opacities <= settings.dead_opacity)
    alive = np.flatnonzero(opacities > settings.dead_opacity)
    if not len(alive):
        raise TrainingError(
            f"all splats are fainter than {settings.dead_opacity:g} after iteration {iteration}; check the "
            "data set's cameras and points"
        )
    if len(dead):
        sources = alive[_sampled(opacities[alive], len(dead), settings, Purpose.RELOCATION, iteration)]
        _share(splats, sources, settings)
        for name in NAMES:
            splats.values[name][dead] = splats.values[name][sources]
        for remembered in (splats.first, splats.second):
            for array in remembered.values():
                array[sources] = 0
    target = min(settings.max_splats, int(settings.growth * len(splats)))
    if target > len(splats):
        sources = _sampled(splats.opacities, target - len(splats), settings, Purpose.GROWTH, iteration)
        _share(splats, sources, settings)
        splats = splats.with_more({name: splats.values[name][sources] for name in NAMES})
    return forgotten(splats)


def shake(splats: Splats, settings: TrainSettings, iteration: int, rate: float) -> None:
    """Moves the means at random within their disks, the fainter the further.

    rate: the learning rate of the means, metres.
    """
    turns = quaternion_to_matrix(splats.values["quats"])[:, :, :2]
    draws = normal(settings.seed, Purpose.NOISE, iteration, len(splats))[:, :3]
    faint = sigmoid(-STEEP * (splats.opacities.astype(np.float64) - (1 - CLEAR)))
    inside = np.einsum("nji,nj->ni", turns, draws) * splats.scales.astype(np.float64) ** 2
    step = np.einsum("nij,nj->ni", turns, inside) * (faint * rate * settings.noise)[:, None]
    splats.values["means"] += step.astype(np.float32)


def _sampled(
    weights: np.ndarray, count: int, settings: TrainSettings, purpose: Purpose, iteration: int
) -> np.ndarray:
    """Random indices (count,), each as likely as its weight."""
    sums = np.cumsum(weights, dtype=np.float64)
    places = uniform(settings.seed, purpose, iteration, count)[:, 0] * sums[-1]
    return np.minimum(np.searchsorted(sums, places, side="right"), len(weights) - 1)


def _share(splats: Splats, sources: np.ndarray, settings: TrainSettings) -> None:
    """Gives splats that stand for themselves and copies the opacity and scales by which all look as one
    did (section 4.2 of the paper)."""
    rows, copies = np.unique(sources, return_counts=True)
    number = np.minimum(copies + 1, MOST_COPIES)
    opacity = splats.opacities[rows].astype(np.float64)
    new = 1 - (1 - opacity) ** (1 / number)
    sums = _sums(new)[np.arange(len(rows)), number - 1]
    new = np.clip(new, settings.dead_opacity, 1 - np.finfo(np.float32).eps)
    splats.values["logits"][rows] = (np.log(new) - np.log1p(-new)).astype(np.float32)
    splats.values["log_scales"][rows] += np.log(opacity / sums).astype(np.float32)[:, None]


def _sums(opacity: np.ndarray) -> np.ndarray:
    """What N equal splats of this opacity amount to along a line, (n, 51) for N = 1 to 51."""
    powers = opacity[:, None] ** np.arange(1, MOST_COPIES + 1)
    return np.cumsum(powers @ _terms().T, axis=1)


@cache
def _terms() -> np.ndarray:
    """(51, 51): (-1)^k C(i, k) / sqrt(k + 1)."""
    size = range(MOST_COPIES)
    return np.array([[(-1) ** k * comb(i, k) / np.sqrt(k + 1) for k in size] for i in size])
