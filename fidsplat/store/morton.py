"""Morton codes of splats on a cubic grid of 2^21 cells a side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BITS = 21
"""bits of a code per axis"""


def _interleaved(bits: int) -> np.ndarray:
    """Table (2^bits,) uint64: the bits of each index, with two zeros after each bit."""
    index = np.arange(1 << bits, dtype=np.uint64)
    spread = np.zeros_like(index)
    for bit in range(bits):
        spread |= ((index >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit)
    return spread


_LOW_BITS = 11
_TABLE = _interleaved(_LOW_BITS)


@dataclass(frozen=True)
class Grid:
    """Cube divided into cells; points outside belong to the nearest cell."""

    low: tuple[float, float, float]
    """minimum corner, in metres relative to the origin"""
    side: float
    """edge of the cube [m]"""

    def codes(self, means: np.ndarray) -> np.ndarray:
        """Morton codes (n,) uint64 of centres (n, 3)."""
        scale = (1 << BITS) / self.side
        codes = np.zeros(len(means), np.uint64)
        for axis in range(3):
            cells = (means[:, axis].astype(np.float64) - self.low[axis]) * scale
            index = np.clip(cells, 0, (1 << BITS) - 1).astype(np.int64)
            high, low = index >> _LOW_BITS, index & ((1 << _LOW_BITS) - 1)
            codes |= (_TABLE[high] << np.uint64(3 * _LOW_BITS) | _TABLE[low]) << np.uint64(axis)
        return codes

    def size(self, shift: int) -> float:
        """Edge [m] of cells after `shift` levels of grid cells are combined."""
        return self.side / (1 << BITS) * (1 << shift)


def grid_around(means: np.ndarray) -> Grid:
    """Grid around a sample of centres (n, 3)."""
    if not len(means):
        return Grid((0.0, 0.0, 0.0), 1.0)
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    side = max(float((high - low).max()) * 1.01, 1e-6)
    corner = (low + high) / 2 - side / 2
    return Grid((float(corner[0]), float(corner[1]), float(corner[2])), side)
