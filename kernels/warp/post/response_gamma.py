"""Response curve v^(1 / gamma)."""

from typing import Any

import warp as wp

from ..fast import fast_exp, fast_log
from . import Step

LEAST_NORMAL = wp.constant(wp.float32(2.0**-126))


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    light = wp.clamp(v, 0.0, 1.0)
    if not (light >= LEAST_NORMAL):
        return 0.0
    return fast_exp(fast_log(light) * s.inverse_gamma)


STEP = Step(uniforms=("inverse_gamma",), numbers={"inverse_gamma": wp.float32}, apply=apply)
