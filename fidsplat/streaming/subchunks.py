"""Pieces of chunks, rows that lie next to each other on the curve, in boxes of their own: of a chunk that is
not hidden as a whole, some are. Their boxes are made when a view first needs the chunk."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from fidsplat.store.store import Store

ROWS = 1024
"""splats of a piece"""


@dataclass(frozen=True)
class Pieces:
    """Of nodes of a store, in the order of their splats."""

    nodes: np.ndarray
    """(k,) int64 whose they are"""
    first: np.ndarray
    """(k,) int64 rows of the node at which they begin"""
    rows: np.ndarray
    """(k,) int64 how many they have"""
    low: np.ndarray
    """(k, 3) float64 metres: corners of boxes around their centres, as `high`"""
    high: np.ndarray
    reach: np.ndarray
    """(k,) metres: largest standard deviation"""
    always: np.ndarray
    """(k,) bool: those that every picture has"""

    def only(self, which: np.ndarray) -> Pieces:
        """Some of them (k,) bool."""
        return Pieces(*(getattr(self, field.name)[which] for field in fields(self)))

    def boxes(self, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
        """As `Store.boxes`."""
        around = sigmas * self.reach[:, None]
        return self.low - around, self.high + around


class PiecesOf:
    """The pieces of a store, as views come to need them."""

    def __init__(self, store: Store, move: np.ndarray, pinned: np.ndarray) -> None:
        """move: (3,) metres, to the origin from which views see the store. pinned: (n,) bool nodes that every
        picture has."""
        self._store, self._move, self._pinned = store, move, pinned
        self._known: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        """of a node of one place: boxes, and the largest standard deviation in each"""

    def of(self, numbers: np.ndarray) -> Pieces:
        """Those of nodes (k,) by their numbers."""
        store = self._store
        places, own = np.divmod(numbers, max(len(store.nodes), 1))
        each = [self._boxes(node) for node in own.tolist()]
        counts = np.array([len(reach) for _, _, reach in each], np.int64)
        nodes, place = np.repeat(numbers, counts), np.repeat(places, counts)
        low, high = (np.concatenate([np.empty((0, 3)), *(one[corner] for one in each)]) for corner in (0, 1))
        reach = np.concatenate([np.empty(0), *(one[2] for one in each)])
        if store.poses is not None:
            low, high = store.placed_boxes(low, high, place)
        first = ROWS * (np.arange(len(nodes)) - np.repeat(np.cumsum(counts) - counts, counts))
        rows = np.minimum(store.counts(nodes) - first, ROWS)
        low, high = low + self._move, high + self._move
        return Pieces(nodes, first, rows, low, high, reach, self._pinned[nodes])

    def _boxes(self, node: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if node not in self._known:
            splats = self._store.load(node, placed=False)
            starts = np.arange(0, len(splats["means"]), ROWS)
            widest = splats["scales"].max(axis=1)
            if "thickness" in splats:
                widest = np.maximum(widest, splats["thickness"])
            self._known[node] = (
                np.minimum.reduceat(splats["means"], starts, axis=0).astype(np.float64),
                np.maximum.reduceat(splats["means"], starts, axis=0).astype(np.float64),
                np.maximum.reduceat(widest, starts).astype(np.float64),
            )
        return self._known[node]
