"""Culling of splats for a block of samples, by interval arithmetic over the samples' coordinates.

A culled splat has an opacity of exactly 0 at each sample for any rounding. The bounding boxes of devices are
not used, so that a comparison finds errors in them.
"""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference.optics import ROUND, Samples, away_of, samples_of
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View

_SPARE = 1.001
"""relative padding of intervals; far more than their rounding in float64"""


def may_contribute(s: ProjectedSplats, view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(n,) bool: whether each splat may contribute to any sample (k,) at grid positions x, y. The first splat
    of a visible coplanar group always counts, as it determines the layer's position in the order."""
    samples = samples_of(view, x, y)
    if not samples.valid.any():
        return np.zeros(len(s.order), bool)
    valid = samples.valid[:, 0]
    x, y, coordinates = x[valid], y[valid], samples.coordinates[:, valid, 0]
    low, high = coordinates.min(1), coordinates.max(1)
    middle, half = (low + high) / 2, (high - low) / 2
    corners = Samples(_ends(x), _ends(y), np.stack([low, high], 1)[..., None], np.ones((2, 1), bool))
    away = away_of(view, corners, s.anchors).max(1)
    slack = ROUND * (np.abs(s.log_opacity) + s.half_r2)

    def rounding(form: np.ndarray) -> np.ndarray:
        largest = np.abs(middle @ form) + half @ np.abs(form)
        return _SPARE * s.round * (largest + (away * np.abs(form)).sum(0))

    d = s.forms[:, :, 2]
    d_error = rounding(d)
    d_high = middle @ d + half @ np.abs(d) + d_error
    reach = _steps(view, x, y) if s.box.any() else np.zeros(3)
    q_low, meets = np.zeros(len(s.order)), np.ones(len(s.order), bool)
    for form in (s.forms[:, :, 0], s.forms[:, :, 1]):
        error = rounding(form)
        q_low += np.maximum(np.abs(middle @ form) - half @ np.abs(form) - error, 0) ** 2
        # the edge of a box splat is antialiased half a sample outwards, and the gradient's terms are rounded
        off = d_error + 1.5 * error + 2 * ROUND * (reach @ (np.abs(d) + np.abs(form)))
        for side in (d + form, d - form):
            meets &= middle @ side + (half + reach) @ np.abs(side) + _SPARE * off > 0
    r2 = 2 * (s.half_r2 + slack) * _SPARE
    with np.errstate(divide="ignore", invalid="ignore"):
        # for a 3D Gaussian rho is divided by 1 + rho / m^2: below r2 everywhere if m^2 is
        r2_of_disk = np.where(s.inverse_m2 * r2 < 1, r2 / (1 - s.inverse_m2 * r2), np.inf)
        contributing = (d_high > 0) & np.where(s.box, meets, q_low <= d_high**2 * r2_of_disk)
    if s.has_screen_lowpass:
        across, down = _outside(x, s.center_x), _outside(y, s.center_y)
        off = ROUND * (
            1 + sum(np.abs(_ends(at) - to).max(0) for at, to in ((x, s.anchor_x), (y, s.anchor_y)))
        )
        contributing |= np.maximum(np.hypot(across, down) / view.samples - off, 0) ** 2 <= r2 / 2
    return contributing


def _ends(at: np.ndarray) -> np.ndarray:
    return np.array([[at.min()], [at.max()]])


def _outside(at: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Distance of centres (n,) from an interval of positions; 0 inside."""
    return np.maximum(np.maximum(at.min() - center, center - at.max()), 0)


def _steps(view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Upper bound of the change of a ray's coordinates (3,) from a sample to its neighbours."""
    if view.raster is None:
        return np.array([0.0, 1.0, 1.0])
    slopes = np.nan_to_num(view.raster.ray_derivatives[y.astype(int), x.astype(int)].astype(np.float64))
    return np.hypot(slopes[:, 0], slopes[:, 1]).max(0)
