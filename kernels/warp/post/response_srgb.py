"""Response curve of sRGB (IEC 61966-2-1)."""

from typing import Any

import warp as wp

from ..common import fma
from ..fast import fast_exp, fast_log
from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    light = wp.clamp(v, 0.0, 1.0)
    if light <= 0.0031308:
        return 12.92 * light
    return fma(1.055, fast_exp(fast_log(light) * (1.0 / 2.4)), -0.055)


STEP = Step(apply=apply)
