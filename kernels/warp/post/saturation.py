"""Saturation of the sensor's pixels."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return wp.min(v, s.saturation)


STEP = Step(uniforms=("saturation",), numbers={"saturation": wp.float32}, apply=apply)
