"""Counter-based random numbers: functions of seed, iteration, stream and splat index alone.

Philox 4x32-10: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011. The kernel version is
in kernels/opencl/train/position_noise.cl.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

_MULTIPLIERS = 0xD2511F53, 0xCD9E8D57
_WEYL = 0x9E3779B9, 0xBB67AE85
_LOW = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)


class RandomStream(IntEnum):
    """RandomStream of random numbers; each has its own stream."""

    VIEWS = 0
    ROTATIONS = 1
    SPLITS = 2
    NOISE = 3
    RELOCATION = 4
    GROWTH = 5
    POINTS = 6


def philox(counters: np.ndarray, key: int) -> np.ndarray:
    """Four words (n, 4) uint32 for each counter (n, 4) uint32 and a key of 64 bits."""
    c0, c1, c2, c3 = np.asarray(counters, np.uint32).astype(np.uint64).T
    k0, k1 = key & 0xFFFFFFFF, key >> 32 & 0xFFFFFFFF
    for _ in range(10):
        first = c0 * np.uint64(_MULTIPLIERS[0])
        second = c2 * np.uint64(_MULTIPLIERS[1])
        c0, c1, c2, c3 = (
            (second >> _HALF) ^ c1 ^ np.uint64(k0),
            second & _LOW,
            (first >> _HALF) ^ c3 ^ np.uint64(k1),
            first & _LOW,
        )
        k0, k1 = (k0 + _WEYL[0]) & 0xFFFFFFFF, (k1 + _WEYL[1]) & 0xFFFFFFFF
    return np.stack([c0, c1, c2, c3], axis=1).astype(np.uint32)


def uniform(
    seed: int, stream: RandomStream, iteration: int, of: int | np.ndarray, draw: int = 0
) -> np.ndarray:
    """Uniform numbers (n, 4) float64 in (0, 1), four for each index.

    Args:
        of: indices (n,), or n for the first n.
        draw: distinguishes several calls for one stream and iteration.
    """
    indices = np.arange(of) if isinstance(of, int) else of
    counters = np.empty((len(indices), 4), np.uint32)
    counters[:, 0] = indices
    counters[:, 1:] = iteration, stream, draw
    return (philox(counters, seed) + 0.5) * 2.0**-32


def normal(
    seed: int, stream: RandomStream, iteration: int, of: int | np.ndarray, draw: int = 0
) -> np.ndarray:
    """Standard normal numbers (n, 4) float64 (Box and Muller) for each index; arguments of `uniform`."""
    u = uniform(seed, stream, iteration, of, draw)
    radius, angle = np.sqrt(-2 * np.log(u[:, :2])), 2 * np.pi * u[:, 2:]
    return np.concatenate([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def permutation(seed: int, stream: RandomStream, iteration: int, count: int) -> np.ndarray:
    """A random permutation of 0 to count - 1."""
    return np.argsort(uniform(seed, stream, iteration, count)[:, 0], kind="stable")
