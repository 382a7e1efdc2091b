"""Counts of a frame: visible splats, splats that cover many tiles, and (splat, tile) pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

COUNTS = 4
"""words of the buffer `frame_counts`, as in tile_lists.cl: big splats, pairs (two words), visible splats"""
COUNTERS = 8
"""counters of the buffer `counters`, as in prelude.cl"""
VISIBLE, PAIRS, BIG = 0, 2, 6
"""indices of the counters with totals: visible splats (with `KernelConfig.culls_first` groups of splats that
are not culled), pairs (two words), big splats"""


@dataclass(frozen=True)
class Counts:
    """Numbers of splats and pairs of a frame, of all its views."""

    big: int
    """number of splats whose tiles do not fit into a window (bit mask of 8 x 4 tiles)"""
    pairs: int
    visible: int

    @staticmethod
    def read(queue: cl.CommandQueue, counts: cl.Buffer, after: Sequence[cl.Event] | None = None) -> Counts:
        """Read the buffer `frame_counts` once the events have completed."""
        words = np.empty(COUNTS, np.uint32)
        cl.enqueue_copy(queue, words, counts, wait_for=after)
        return Counts(int(words[0]), int(words[1]) | int(words[2]) << 32, int(words[3]))

    @staticmethod
    def of_counters(words: np.ndarray) -> Counts:
        """Counts of a frame from the buffer `counters` (views, COUNTERS), without `culls_first`. The first
        row has the pairs and big splats of all views, and each row the visible splats of its view."""
        first, visible = words[0].tolist(), sum(words[:, VISIBLE].tolist())
        return Counts(first[BIG], first[PAIRS] | first[PAIRS + 1] << 32, visible)

    def stats(self, splats: int) -> dict[str, int]:
        return {"splats": splats, "visible": self.visible, "pairs": self.pairs}


@dataclass(frozen=True)
class Capacity:
    """Buffer sizes of a frame that is submitted before the host knows its counts."""

    big: int
    pairs: int

    def holds(self, counts: Counts) -> bool:
        """Whether the counts fit; otherwise the frame's lists are empty, and it must be rendered again."""
        return counts.big <= self.big and counts.pairs <= self.pairs


def read_stats(queue: cl.CommandQueue, counts: cl.Buffer, last: cl.Event, splats: int) -> dict[str, int]:
    """`Frame.stats` of a frame whose last launch was `last`, on a queue that is flushed."""
    return Counts.read(queue, counts, [last]).stats(splats)


def enlarged(pairs: int, budget: int) -> int:
    """New capacity for lists that are too small, with a margin for the next view."""
    return max(pairs, min(pairs * 9 // 8, budget))
