"""Shot noise and read noise: a normal variate from a hash of pixel, channel and seed, with a variance that
grows with the light."""

from typing import Any

import warp as wp

from ..common import fma
from . import Step

_FACTOR, _ADDED = wp.constant(wp.uint32(1664525)), wp.constant(wp.uint32(1013904223))
_LOW, _HALF = wp.constant(wp.uint32(0xFFFF)), wp.constant(wp.uint32(16))
_WORDS = wp.types.vector(4, wp.uint32)


@wp.func
def pcg4d(x: wp.uint32, y: wp.uint32, z: wp.uint32, w: wp.uint32) -> _WORDS:
    """Hash pcg4d of four counters (Jarzynski and Olano 2020)."""
    v = _WORDS(x, y, z, w) * _FACTOR
    for i in range(4):
        v[i] = v[i] + _ADDED
    for turn in range(2):
        v[0] = v[0] + v[1] * v[3]
        v[1] = v[1] + v[2] * v[0]
        v[2] = v[2] + v[0] * v[1]
        v[3] = v[3] + v[1] * v[2]
        if turn == 0:
            for i in range(4):
                v[i] = v[i] ^ (v[i] >> _HALF)
    return v


@wp.func
def variate(x: int, y: int, channel: int, seed: wp.uint32) -> float:
    """Approximately normal random number of mean 0 and variance 1: the sum of twelve uniform 16-bit numbers,
    added as integers, so that it is equal on all devices.
    """
    total = int(0)
    for part in range(2):
        words = pcg4d(wp.uint32(x), wp.uint32(y), wp.uint32(2 * channel + part), seed)
        for i in range(4):
            if part == 0 or i < 2:
                total += int(words[i] & _LOW) + int(words[i] >> _HALF)
    return float(total - 6 * 65535) / 65536.0


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    deviation = wp.sqrt(fma(wp.max(v, 0.0), s.shot_variance, s.read_variance))
    return fma(deviation, variate(x, y, channel, s.seed), v)


STEP = Step(
    uniforms=("noise",),
    numbers={"shot_variance": wp.float32, "read_variance": wp.float32, "seed": wp.uint32},
    apply=apply,
)
