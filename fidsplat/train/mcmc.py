"""3DGS-MCMC (Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo", 2024): relocation of
dead splats, growth up to a limit, and noise on the means.
"""

from __future__ import annotations

from functools import cache
from math import comb

import numpy as np

from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.train.densify import with_statistics_reset
from fidsplat.train.parameters import NAMES, Splats, TrainingError, sigmoid
from fidsplat.train.random_numbers import RandomStream, normal, uniform
from fidsplat.train.settings import TrainSettings

MAX_COPIES = 51
"""maximum number of copies in the relocation formula"""
NOISE_SLOPE, NOISE_CUTOFF = 100.0, 0.995
"""slope and threshold of the sigmoid that reduces the noise of opaque splats"""


def relocate_and_grow(splats: Splats, settings: TrainSettings, iteration: int) -> Splats:
    """The splats after relocation and growth. The opacity and the scales of a splat are divided among its
    copies such that the rendered image stays the same.

    Raises:
        TrainingError: every splat is dead.
    """
    opacities = splats.opacities
    dead = np.flatnonzero(opacities <= settings.dead_opacity)
    alive = np.flatnonzero(opacities > settings.dead_opacity)
    if not len(alive):
        raise TrainingError(
            f"opacities after iteration {iteration} must be above {settings.dead_opacity:g} for at least one "
            f"splat, got at most {opacities.max(initial=0):.2g}; check the data set's cameras and points"
        )
    if len(dead):
        sources = alive[_sample(opacities[alive], len(dead), settings, RandomStream.RELOCATION, iteration)]
        _divide_among_copies(splats, sources, settings)
        for name in NAMES:
            splats.values[name][dead] = splats.values[name][sources]
        for moments in (splats.first, splats.second):
            for array in moments.values():
                array[sources] = 0
    target = min(settings.max_splats, int(settings.growth * len(splats)))
    if target > len(splats):
        sources = _sample(splats.opacities, target - len(splats), settings, RandomStream.GROWTH, iteration)
        _divide_among_copies(splats, sources, settings)
        splats = splats.append({name: splats.values[name][sources] for name in NAMES})
    return with_statistics_reset(splats)


def add_noise(splats: Splats, settings: TrainSettings, iteration: int, rate: float) -> None:
    """Add noise with each splat's covariance to the means; it decreases with opacity.

    rate: learning rate of the means [m].
    """
    scales = splats.scales.astype(np.float64)
    axes = quaternion_to_matrix(splats.values["quats"])[:, :, : scales.shape[1]]
    draws = normal(settings.seed, RandomStream.NOISE, iteration, len(splats))[:, :3]
    transparent = sigmoid(-NOISE_SLOPE * (splats.opacities.astype(np.float64) - (1 - NOISE_CUTOFF)))
    inside = np.einsum("nji,nj->ni", axes, draws) * scales**2
    step = np.einsum("nij,nj->ni", axes, inside) * (transparent * rate * settings.noise)[:, None]
    splats.values["means"] += step.astype(np.float32)


def _sample(
    weights: np.ndarray, count: int, settings: TrainSettings, stream: RandomStream, iteration: int
) -> np.ndarray:
    """Random indices (count,), with probabilities proportional to the weights."""
    sums = np.cumsum(weights, dtype=np.float64)
    draws = uniform(settings.seed, stream, iteration, count)[:, 0] * sums[-1]
    return np.minimum(np.searchsorted(sums, draws, side="right"), len(weights) - 1)


def _divide_among_copies(splats: Splats, sources: np.ndarray, settings: TrainSettings) -> None:
    """Set the opacity and scales of each source so that it and its copies render like the source alone
    (section 4.2 of the paper)."""
    rows, copies = np.unique(sources, return_counts=True)
    number = np.minimum(copies + 1, MAX_COPIES)
    opacity = splats.opacities[rows].astype(np.float64)
    new = 1 - (1 - opacity) ** (1 / number)
    # integrated alpha of N equal splats along a line, for N = 1 to 51
    integrals = np.cumsum(new[:, None] ** np.arange(1, MAX_COPIES + 1) @ _binomial_terms().T, axis=1)
    sums = integrals[np.arange(len(rows)), number - 1]
    new = np.clip(new, settings.dead_opacity, 1 - np.finfo(np.float32).eps)
    splats.values["logits"][rows] = (np.log(new) - np.log1p(-new)).astype(np.float32)
    splats.values["log_scales"][rows] += np.log(opacity / sums).astype(np.float32)[:, None]


@cache
def _binomial_terms() -> np.ndarray:
    """(51, 51): (-1)^k C(i, k) / sqrt(k + 1)."""
    size = range(MAX_COPIES)
    return np.array([[(-1) ** k * comb(i, k) / np.sqrt(k + 1) for k in size] for i in size])
