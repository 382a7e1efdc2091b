"""White balance: a factor for each channel."""

from typing import Any

import warp as wp

from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    factor = s.balance_r
    if channel == 1:
        factor = s.balance_g
    if channel == 2:
        factor = s.balance_b
    return v * factor


STEP = Step(
    uniforms=("white_balance",),
    numbers={name: wp.float32 for name in ("balance_r", "balance_g", "balance_b")},
    apply=apply,
)
