"""Pictures with more pairs of splats and tiles than there is room for are drawn in bands of tiles, with the
same bits."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np


def cut(totals: np.ndarray, most: int, start: int = 0) -> Iterator[tuple[int, int, int]]:
    """Ranges of tiles (first, end, pairs), of at most so many pairs together; at least one tile, whatever its
    list.

    totals (k,): lengths of the lists of the tiles from `start` on.
    """
    ends = np.cumsum(totals, dtype=np.int64)
    first, done = 0, 0
    while first < len(ends):
        end = max(int(np.searchsorted(ends, done + most, side="right")), first + 1)
        yield start + first, start + end, int(ends[end - 1]) - done
        first, done = end, int(ends[end - 1])
