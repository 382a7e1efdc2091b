"""Exposure: scales the light."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return v * s.exposure


STEP = Step(uniforms=("exposure",), numbers={"exposure": wp.float32}, apply=apply)
