"""Termination depths: the depth at which blending of each tile stopped, for occlusion culling.

Blending processes a tile's list in depth order until all pixels of the tile are opaque. The device stores the
depth key of the last splat (part/termination_depth_*.cl). A splat with a larger key in every tile that it can
touch does not change the frame, so it can be left out. This holds for every output and depth order.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class TerminationDepths:
    """Depth at which blending of each tile of a frame stopped."""

    depths: np.ndarray
    """(rows, columns) float32: sort key in metres; infinite for tiles that are not opaque"""
    tile: tuple[int, int]
    """rows and columns of samples in a tile"""

    def within(self, tiles: np.ndarray) -> TerminationDepths:
        """A copy with -inf (nothing visible) in all tiles except those of a mask (rows, columns) bool."""
        return replace(self, depths=np.where(tiles, self.depths, np.float32(-np.inf)))

    def replaced(self, tiles: np.ndarray, other: TerminationDepths) -> TerminationDepths:
        """A copy with the depths of another frame in the tiles of a mask (rows, columns) bool."""
        return replace(self, depths=np.where(tiles, other.depths, self.depths))

    @staticmethod
    def of_keys(keys: np.ndarray, tile: tuple[int, int]) -> TerminationDepths:
        """Convert the kernels' sortable keys (rows, columns) uint32; all bits set: the tile is not opaque."""
        bits = np.where(keys & 0x80000000, keys ^ np.uint32(0x80000000), ~keys).astype(np.uint32)
        depths = bits.view(np.float32).copy()
        depths[(keys == 0xFFFFFFFF) | np.isnan(depths)] = np.inf
        return TerminationDepths(depths, tile)
