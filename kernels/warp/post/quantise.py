"""Quantisation to the steps of the analogue-to-digital converter."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return wp.rint(wp.clamp(v, 0.0, 1.0) * s.steps) / s.steps


STEP = Step(uniforms=("quantise_steps",), numbers={"steps": wp.float32}, apply=apply)
