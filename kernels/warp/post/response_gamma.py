"""Response: a power of the light."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return wp.pow(wp.clamp(v, 0.0, 1.0), s.inverse_gamma)


STEP = Step(uniforms=("inverse_gamma",), numbers={"inverse_gamma": wp.float32}, apply=apply)
