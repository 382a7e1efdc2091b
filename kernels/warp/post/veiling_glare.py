"""Veiling glare: a share of the light is scattered evenly over the image."""

from typing import Any

import warp as wp

from ..common import fma
from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    light = s.glare_r
    if channel == 1:
        light = s.glare_g
    if channel == 2:
        light = s.glare_b
    return fma(v, s.glare_rest, light)


STEP = Step(
    uniforms=("veiling_glare",),
    numbers={name: wp.float32 for name in ("glare_rest", "glare_r", "glare_g", "glare_b")},
    apply=apply,
)
