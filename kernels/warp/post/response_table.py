"""Response curve from a table at equal steps of light from 0 to 1, with linear interpolation."""

from typing import Any

import warp as wp

from ..common import fma
from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    position = wp.clamp(v, 0.0, 1.0) * float(s.points - 1)
    below = wp.min(int(position), s.points - 2)
    step = s.response[below + 1] - s.response[below]
    return fma(position - float(below), step, s.response[below])


STEP = Step(
    uniforms=("response_count",),
    numbers={"points": wp.int32},
    arrays={"response": wp.float32},
    apply=apply,
)
