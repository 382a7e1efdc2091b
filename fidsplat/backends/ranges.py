"""Splitting of consecutive items into ranges of bounded size or cost, for work that exceeds the memory
budget."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np


def even_ranges(count: int, max_size: int) -> Iterator[tuple[int, int]]:
    """Ranges [first, end) of at most `max_size` items each, whose sizes differ by at most one, so that they
    share buffers and command lists."""
    ranges = -(-count // max_size)
    return pairwise([count * k // max(ranges, 1) for k in range(ranges + 1)])


def split_by_cost(costs: np.ndarray, capacity: int, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """Split consecutive items, numbered from `start`, with costs (k,) into ranges (first, end, cost) that
    cost at most `capacity` each. A range has at least one item, whatever its cost."""
    ends = np.cumsum(costs, dtype=np.int64)
    first, split = 0, 0  # `split`: cost of the items before `first`
    while first < len(ends):
        end = max(int(np.searchsorted(ends, split + capacity, side="right")), first + 1)
        yield start + first, start + end, int(ends[end - 1]) - split
        first, split = end, int(ends[end - 1])
