"""Splitting of a frame into bands of bounded cost, for frames that exceed the memory budget."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np


def even_parts(count: int, most: int) -> Iterator[tuple[int, int]]:
    """Ranges [first, end) of at most `most` items each, whose sizes differ by at most one, so that they
    share buffers and recorded launches."""
    parts = -(-count // most)
    return pairwise([count * k // max(parts, 1) for k in range(parts + 1)])


def split_by_cost(costs: np.ndarray, capacity: int, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """Split consecutive items, numbered from `start`, with costs (k,) into ranges (first, end, cost) that
    cost at most `capacity` each. A range has at least one item, whatever its cost."""
    ends = np.cumsum(costs, dtype=np.int64)
    first, done = 0, 0
    while first < len(ends):
        end = max(int(np.searchsorted(ends, done + capacity, side="right")), first + 1)
        yield start + first, start + end, int(ends[end - 1]) - done
        first, done = end, int(ends[end - 1])
