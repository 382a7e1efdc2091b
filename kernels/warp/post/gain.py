"""Gain: amplifies the signal and its noise."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    return v * s.gain


STEP = Step(uniforms=("gain",), numbers={"gain": wp.float32}, apply=apply)
