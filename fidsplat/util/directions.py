"""Unit vectors, perpendicular vectors, and uniform samples of a sphere and a disk."""

import numpy as np

GOLDEN = np.pi * (3 - np.sqrt(5))
"""golden angle in radians"""


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) of length 1; (0, 0, 1) for vectors of length 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0, vectors / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def perpendicular(axes: np.ndarray) -> np.ndarray:
    """Two unit vectors (..., 2, 3) perpendicular to unit vectors (..., 3) and to each other."""
    first = unit(np.cross(axes, np.eye(3)[np.argmin(np.abs(axes), axis=-1)]))
    return np.stack([first, np.cross(axes, first)], -2)


def sphere(count: int, lowest: float = -1.0) -> np.ndarray:
    """Fibonacci lattice: uniform unit vectors (n, 3) with z from `lowest` to 1."""
    i = np.arange(count)
    z, angle = 1 - (1 - lowest) * (i + 0.5) / count, GOLDEN * i
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)


def disk(count: int, first: float = 0.5) -> np.ndarray:
    """Vogel's spiral: uniform points (n, 2) of the unit disk. first: 0 for a point at the centre."""
    i = np.arange(count)
    radius, angle = np.sqrt((i + first) / max(count - 0.5 + first, 1)), GOLDEN * i
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
