"""Fragments: what samples see of each splat before compositing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.reference.setup import Setup

DARKEST = 24 * math.log(2)
"""optical depth at which float32 leaves no light"""


@dataclass
class Fragments:
    """k samples against n splats; arrays (k, n) float64."""

    dx: np.ndarray
    """distance from the anchor, samples"""
    dy: np.ndarray
    n_u: np.ndarray
    n_v: np.ndarray
    d: np.ndarray
    offset: np.ndarray
    """squared distance from the projected centre, pixels"""
    alpha: np.ndarray
    z: np.ndarray


def fragments_of(s: Setup, view: View, x: np.ndarray, y: np.ndarray) -> Fragments:
    """The fragments of samples (k,) at grid positions x, y."""
    x, y = x[:, None], y[:, None]
    n_u, n_v, d = (s.forms[0, :, c] + x * s.forms[1, :, c] + y * s.forms[2, :, c] for c in range(3))
    q = n_u * n_u + n_v * n_v
    inside = (q <= 2 * s.half_r2 * d * d) & (d > 0) & (d * view.near <= s.z_numerator)
    offset = ((x - s.center_x) ** 2 + (y - s.center_y) ** 2) / view.samples**2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        half_rho = np.where(inside, q / (2 * d * d), np.inf)
        z = s.z_numerator / d
    if s.screen:
        half_rho = np.minimum(half_rho, np.where(offset <= s.half_r2, offset, np.inf))
    z = np.where(d > 0, np.clip(z, s.pz - s.reach, s.pz + s.reach), s.pz)
    alpha = np.minimum(np.exp(s.log_opacity - half_rho), view.ceiling)
    return Fragments(np.abs(x - s.anchor_x), np.abs(y - s.anchor_y), n_u, n_v, d, offset, alpha, z)


def optical_depth(alpha: np.ndarray) -> np.ndarray:
    """-ln(1 - alpha), at most `DARKEST`."""
    return np.minimum(-np.log1p(-np.clip(alpha, 0.0, 1 - 2.0**-24)), DARKEST)


def shifted(after: np.ndarray, last: bool = False) -> np.ndarray:
    """What is in front of each fragment (k, n), from what is left behind each.

    last: also of what comes after them all, (k, n + 1).
    """
    before = np.concatenate([np.ones((len(after), 1)), after], axis=1)
    return before if last else before[:, :-1]
