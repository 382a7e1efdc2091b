"""Confidence intervals of 95 %: Wilson's of a share, and bootstrap intervals of statistics."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

NORMAL = 1.959963984540054
"""quantile 0.975 of the normal distribution"""
RESAMPLES = 1000


def wilson(hits: int, count: int) -> tuple[float, float]:
    """Wilson's score interval of a share (Wilson 1927); (0, 1) without measurements."""
    if count == 0:
        return 0.0, 1.0
    share, square = hits / count, NORMAL**2 / count
    middle = (share + square / 2) / (1 + square)
    half = NORMAL / (1 + square) * math.sqrt(share * (1 - share) / count + square / (4 * count))
    # the ends are exact for no hit and for hits only
    return 0.0 if hits == 0 else middle - half, 1.0 if hits == count else middle + half


def bootstrap(
    values: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of a statistic over resampled values (Efron 1979); NaN without values.

    statistic: (resamples, n) -> (resamples,).
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        return math.nan, math.nan
    chosen = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(statistic(values[chosen]), (2.5, 97.5))
    return float(low), float(high)


def percentile(percent: float) -> Callable[[np.ndarray], np.ndarray]:
    """The percentile along the last axis, as a statistic."""
    return lambda values: np.percentile(values, percent, axis=-1)


def root_mean_square(values: np.ndarray) -> np.ndarray:
    """Root mean square along the last axis."""
    return np.sqrt((np.asarray(values) ** 2).mean(-1))
