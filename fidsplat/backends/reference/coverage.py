"""Median depth, and the minimum coverage of samples that have a label, depth and normal."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference.error_bounds import STOP, Span

MIN_ALPHA = 1 / 255
"""minimum alpha of a sample with a label, depth or normal, at any cut-off"""
_ROUND = 2.0**-24  # relative rounding error of a transmittance per composited fragment


def median_of(
    before: np.ndarray, alpha: np.ndarray, contributes: np.ndarray, span: Span
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the fragment or layer of the median depth: the last in front of which transmittance exceeds 0.5.

    Consecutive fragments that absorb less than `MIN_ALPHA` together count as the last of them.

    Args:
        before: (k, m) transmittance in front of each of m fragments or layers.
        alpha: (k, m). contributes: (k, m) bool.

    Returns:
        (k,) index; (k,) whether there is one; (k,) whether rounding to float32 may choose another.
    """
    k = len(before)
    last, left = np.full(k, -1), np.ones(k)  # left: transmittance behind the last fragment that counted
    may_flip, slack = np.zeros(k, bool), np.zeros(k)
    may = (span.high > 0) & (span.front_high > 0.5 * (1 - STOP))
    must = (span.low > 0) & (span.front_low > 0.5 * (1 + STOP))
    counted = contributes & (before > 0.5)
    for column in np.flatnonzero(may.any(0)).tolist():
        at = np.s_[:, column]
        behind = before[at] * (1 - alpha[at])
        lowest, highest = span.front_low[at] * (1 - span.high[at]), span.front_high[at] * (1 - span.low[at])
        # rounding error of the difference of two transmittances
        slack = np.where(may[at], np.maximum(slack, 2 * (highest - lowest)) + 2 * _ROUND, slack)
        taken = left - behind - MIN_ALPHA
        may_flip |= may[at] & (taken >= -slack) & ~(must[at] & (taken > slack))
        counts = counted[at] & (taken >= 0)
        last, left = np.where(counts, column, last), np.where(counts, behind, left)
    return np.maximum(last, 0), last >= 0, may_flip
