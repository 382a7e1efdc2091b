"""Which splats some neighbouring samples may see, by interval arithmetic over their forms.

A splat that is left out has an opacity of exactly 0 at each of the samples, whatever float32 makes of its
forms: nothing that is composited changes. Bounds of footprints, as devices have them, are not computed: what
those lose shows in a comparison with the reference as it would without this.
"""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference.optics import ROUND, Samples, away_of, samples_of
from fidsplat.backends.reference.setup import Setup
from fidsplat.backends.view import View

_SPARE = 1.001
"""relative: rounding of the intervals themselves in float64 is far less"""


def may_see(s: Setup, view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Whether any of the samples (k,) at grid positions x, y may see each splat, (n,) bool.

    The first splat of a plane of which any is seen is kept: the layer arrives with it.
    """
    samples = samples_of(view, x, y)
    if not samples.seen.any():
        return np.zeros(len(s.order), bool)
    seeing = samples.seen[:, 0]
    x, y, coordinates = x[seeing], y[seeing], samples.coordinates[:, seeing, 0]
    low, high = coordinates.min(1), coordinates.max(1)
    middle, half = (low + high) / 2, (high - low) / 2
    corners = Samples(_ends(x), _ends(y), np.stack([low, high], 1)[..., None], np.ones((2, 1), bool))
    away = away_of(view, corners, s.anchors).max(1)
    slack = ROUND * (np.abs(s.log_opacity) + s.half_r2)

    def rounding(form: np.ndarray) -> np.ndarray:
        largest = np.abs(middle @ form) + half @ np.abs(form)
        return _SPARE * s.round * (largest + (away * np.abs(form)).sum(0))

    u, v, d = (s.forms[:, :, c] for c in range(3))
    errors = [rounding(form) for form in (u, v, d)]
    d_high = middle @ d + half @ np.abs(d) + errors[2]
    q_low = sum(
        np.maximum(np.abs(middle @ form) - half @ np.abs(form) - error, 0) ** 2
        for form, error in zip((u, v), errors, strict=False)
    )
    seen = ~s.box & (q_low <= 2 * d_high**2 * (s.half_r2 + slack) * _SPARE)
    if s.box.any():
        reach = _steps(view, x, y)
        meets = s.box.copy()
        for form, error in zip((u, v), errors, strict=False):
            # an edge shows half a sample beyond it, and the gradient's terms are rounded
            off = errors[2] + 1.5 * error + 2 * ROUND * (reach @ (np.abs(d) + np.abs(form)))
            for side in (d + form, d - form):
                meets &= middle @ side + (half + reach) @ np.abs(side) + _SPARE * off > 0
        seen |= meets
    seen &= d_high > 0
    if s.screen:
        across, down = _outside(x, s.center_x), _outside(y, s.center_y)
        off = ROUND * (
            1 + sum(np.abs(_ends(at) - to).max(0) for at, to in ((x, s.anchor_x), (y, s.anchor_y)))
        )
        seen |= (
            np.maximum(np.hypot(across, down) / view.samples - off, 0) ** 2 <= (s.half_r2 + slack) * _SPARE
        )
    if s.planes is not None:
        planes, first = np.unique(s.planes, return_index=True)
        seen[first[(planes >= 0) & np.isin(planes, s.planes[seen])]] = True
    return seen


def _ends(at: np.ndarray) -> np.ndarray:
    return np.array([[at.min()], [at.max()]])


def _outside(at: np.ndarray, center: np.ndarray) -> np.ndarray:
    """How far centres (n,) lie outside the range of positions."""
    return np.maximum(np.maximum(at.min() - center, center - at.max()), 0)


def _steps(view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """At most how far a sample's coordinates (3,) move with it by one sample in any direction."""
    if view.raster is None:
        return np.array([0.0, 1.0, 1.0])
    slopes = np.nan_to_num(view.raster.slopes[y.astype(int), x.astype(int)].astype(np.float64))
    return np.hypot(slopes[:, 0], slopes[:, 1]).max(0)
