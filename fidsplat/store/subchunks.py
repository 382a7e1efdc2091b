"""Subchunks: runs of 1024 splats of a chunk with their own bounding boxes, for finer occlusion culling."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from fidsplat.store.store import Store

ROWS = 1024
"""splats of a subchunk"""


@dataclass(frozen=True)
class Subchunks:
    """Subchunks of some nodes of a store, in splat order."""

    nodes: np.ndarray
    """(k,) int64 numbers of their nodes"""
    first: np.ndarray
    """(k,) int64 first row within the node"""
    rows: np.ndarray
    """(k,) int64 numbers of rows"""
    low: np.ndarray
    """(k, 3) float64 metres: minimum corners of boxes around the centres"""
    high: np.ndarray
    """(k, 3) float64 metres: maximum corners"""
    max_sigma: np.ndarray
    """(k,) metres: largest standard deviation"""
    pinned: np.ndarray
    """(k,) bool: part of every frame"""

    def only(self, which: np.ndarray) -> Subchunks:
        """The subchunks that a mask (k,) bool selects."""
        return Subchunks(*(getattr(self, field.name)[which] for field in fields(self)))

    def bounding_boxes(self, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
        """Minimum and maximum corners (k, 3) of boxes around splats to `sigmas` standard deviations."""
        around = sigmas * self.max_sigma[:, None]
        return self.low - around, self.high + around


class SubchunkTable:
    """Subchunks of a store, computed on first use.

    offset: (3,) metres, added to all boxes. pinned: (n,) bool: nodes that are part of every frame.
    """

    def __init__(self, store: Store, offset: np.ndarray, pinned: np.ndarray) -> None:
        self._store, self._offset, self._pinned = store, offset, pinned
        self._known: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
        """cache by node without its instance: corners of the boxes, largest standard deviations"""

    def of(self, numbers: np.ndarray) -> Subchunks:
        """The subchunks of nodes (k,), by number."""
        store = self._store
        instances, own_nodes = np.divmod(numbers, max(len(store.nodes), 1))
        boxes = [self._boxes(node) for node in own_nodes.tolist()]
        counts = np.array([len(max_sigma) for _, _, max_sigma in boxes], np.int64)
        nodes, instance = np.repeat(numbers, counts), np.repeat(instances, counts)
        low = np.concatenate([np.empty((0, 3)), *(low for low, _, _ in boxes)])
        high = np.concatenate([np.empty((0, 3)), *(high for _, high, _ in boxes)])
        max_sigma = np.concatenate([np.empty(0), *(max_sigma for _, _, max_sigma in boxes)])
        if store.poses is not None:
            low, high = store.instance_bounding_boxes(low, high, instance)
        first = ROWS * (np.arange(len(nodes)) - np.repeat(np.cumsum(counts) - counts, counts))
        rows = np.minimum(store.counts(nodes) - first, ROWS)
        return Subchunks(
            nodes, first, rows, low + self._offset, high + self._offset, max_sigma, self._pinned[nodes]
        )

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
