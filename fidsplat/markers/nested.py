"""The opaque template: Gaussians that shrink geometrically towards the edges, by a formula instead of a fit.

Along each axis stands one Gaussian in the middle and pairs at the distances d = RATIO^-k from the ends, each
as wide as lets it fall to 1/255, where other renderers cut it off, OVERHANG beyond the end; a template is
their product over both axes. Every point inside lies in the cores of several, so that the rectangle is
opaque up to its edges, and nothing reaches further beyond than the overhang, in whatever order splats are
composited.
"""

from __future__ import annotations

import math

import numpy as np

RATIO = 1.55
PAIRS = 8
OVERHANG = 0.03
"""Half widths of the short side."""
REACH = math.sqrt(2 * math.log(255))
"""Standard deviations at which an opaque Gaussian has fallen to 1/255."""
COPIES = 2
"""A single one leaves 1 % where neighbours meet, and an opacity ceiling of 0.99 as much in its middle."""
CLASSES = ((1.3, 1.0), (2.6, 2.0), (5.2, 4.0), (10.4, 8.0))
"""Largest aspect ratio, aspect ratio that a template is made for."""


def nested_gaussians(aspect: float) -> np.ndarray:
    """A rectangle of that aspect ratio: (n, 5) float64 x, y, sigma_x, sigma_y, opacity in half sizes, the
    long side first."""
    further = math.ceil(math.log(aspect) / math.log(RATIO))
    along, across = _axis(PAIRS + further, OVERHANG / aspect), _axis(PAIRS, OVERHANG)
    rows = [
        (x, y, sx, sy, 1.0)
        for i, x, sx in along
        for j, y, sy in across
        # the smallest of all, in the corners, need no copies
        for _ in range(1 if min(i, j) > PAIRS - 2 else COPIES)
    ]
    gaussians = np.array(rows)
    gaussians.flags.writeable = False
    return gaussians


def _axis(pairs: int, overhang: float) -> list[tuple[int, float, float]]:
    """Step towards the ends, place and sigma of each, in half lengths."""
    steps = [(k, RATIO**-k, side) for k in range(1, pairs + 1) for side in (1, -1)]
    outer = [(k, side * (1 - d), (d + overhang) / REACH) for k, d, side in steps]
    return [(0, 0.0, (1 + overhang) / REACH), *outer]
