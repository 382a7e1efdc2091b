"""Decoding: linear light of display colours by the curve of sRGB, which continues above 1."""

from typing import Any

import warp as wp

from ..fast import fast_exp, fast_log
from . import Step


@wp.func
def apply(v: float, x: int, y: int, channel: int, s: Any) -> float:
    color = wp.max(v, 0.0)
    if color <= 0.04045:
        return color * (1.0 / 12.92)
    exponent = fast_log((color + 0.055) * (1.0 / 1.055)) * 2.4
    power = fast_exp(-wp.abs(exponent))  # for arguments up to 0
    if exponent > 0.0:
        return 1.0 / power
    return power


STEP = Step(apply=apply)
