"""Splitting of a frame into bands by cost: tiles by their splat lists, rows by their splats.

A frame that exceeds the memory budget is rendered band by band, with the same image.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def split_by_cost(costs: np.ndarray, capacity: int, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """Ranges (first, end, cost) of consecutive items with a total cost of at most `capacity` each.

    A range has at least one item, whatever its cost.

    Args:
        costs: (k,) costs of the items from number `start` on.
    """
    ends = np.cumsum(costs, dtype=np.int64)
    first, done = 0, 0
    while first < len(ends):
        end = max(int(np.searchsorted(ends, done + capacity, side="right")), first + 1)
        yield start + first, start + end, int(ends[end - 1]) - done
        first, done = end, int(ends[end - 1])
