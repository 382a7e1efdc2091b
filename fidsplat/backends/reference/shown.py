"""Outputs that name or measure what is seen, where enough is covered: label, splat id, depths, normal."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference.error_bounds import STOP, Span

LEAST_ALPHA = 1 / 255
"""less of a sample than this is nothing to them, however low the cut-off"""
_ROUND = 2.0**-24  # of a transmittance when a fragment is composited


def median_of(
    before: np.ndarray, alpha: np.ndarray, drawn: np.ndarray, span: Span
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place (k,) among the m things of the last in front of which more than half of the light remains,
    whether there is one, and whether single precision may see another.

    Things that take less than `LEAST_ALPHA` count together: the one with which they have taken it stands for
    them. before (k, m): transmittances in front; alpha (k, m); drawn (k, m) bool.
    """
    k = len(before)
    last, left = np.full(k, -1), np.ones(k)  # left: behind the last that counted
    may_flip, slack = np.zeros(k, bool), np.zeros(k)
    may = (span.high > 0) & (span.front_high > 0.5 * (1 - STOP))
    must = (span.low > 0) & (span.front_low > 0.5 * (1 + STOP))
    counted = drawn & (before > 0.5)
    for column in np.flatnonzero(may.any(0)).tolist():
        at = np.s_[:, column]
        behind = before[at] * (1 - alpha[at])
        least, most = span.front_low[at] * (1 - span.high[at]), span.front_high[at] * (1 - span.low[at])
        # of two transmittances that are subtracted
        slack = np.where(may[at], np.maximum(slack, 2 * (most - least)) + 2 * _ROUND, slack)
        taken = left - behind - LEAST_ALPHA
        may_flip |= may[at] & (taken >= -slack) & ~(must[at] & (taken > slack))
        counts = counted[at] & (taken >= 0)
        last, left = np.where(counts, column, last), np.where(counts, behind, left)
    return np.maximum(last, 0), last >= 0, may_flip
