"""Splitting of a frame into bands of bounded cost, for frames that exceed the memory budget.

The cost of a tile is the length of its splat list; the cost of a row is its number of splats. A frame that is
rendered band by band has the same image.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def split_by_cost(costs: np.ndarray, capacity: int, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """Split consecutive items into ranges (first, end, cost) with a total cost of at most `capacity` each.

    A range has at least one item, whatever its cost.

    Args:
        costs: (k,) costs of k items, the first of which has the number `start`.
    """
    ends = np.cumsum(costs, dtype=np.int64)
    first, done = 0, 0
    while first < len(ends):
        end = max(int(np.searchsorted(ends, done + capacity, side="right")), first + 1)
        yield start + first, start + end, int(ends[end - 1]) - done
        first, done = end, int(ends[end - 1])
