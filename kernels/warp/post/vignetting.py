"""Vignetting: a factor that is a polynomial of the squared distance from the principal point."""

from typing import Any

import warp as wp

from ..common import fma
from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    across = (float(x) + 0.5 - s.center_x) * s.per_radius
    down = (float(y) + 0.5 - s.center_y) * s.per_radius
    r2 = fma(across, across, down * down)
    return v * wp.max(fma(r2, fma(r2, fma(r2, s.fall_6, s.fall_4), s.fall_2), 1.0), 0.0)


STEP = Step(
    uniforms=("vignette_center", "vignetting"),
    numbers={
        **{"center_x": wp.float32, "center_y": wp.float32, "per_radius": wp.float32},
        **{"fall_2": wp.float32, "fall_4": wp.float32, "fall_6": wp.float32},
    },
    apply=apply,
)
