"""Templates computed by a formula, not fitted: Gaussians whose sizes shrink geometrically towards the edges.

Along each axis there are a central Gaussian and pairs at the distances d = ratio^-k from the ends. The width
of each follows from its decay at its overhang beyond the end. A template is their product over both axes.
Every interior point is in the cores of several Gaussians.

562 Gaussians of a square are opaque up to its edges and end 0.03 half widths beyond, at the cut-off of other
renderers, so that the compositing order does not matter. 121 transmit a tenth of the light at corners and end
less sharply; they are the start of `fidsplat.train.refine`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fidsplat.capture.quality import LADDER, NESTED

CUT = math.sqrt(2 * math.log(255))
"""Standard deviations at which an opaque Gaussian has fallen to 1/255."""
CLASSES = ((1.3, 1.0), (2.6, 2.0), (5.2, 4.0), (10.4, 8.0))
"""Maximum aspect ratio of a template, and the aspect ratio that it is computed for."""


class Ladder(NamedTuple):
    """Parameters of the geometric series of Gaussians."""

    ratio: float
    pairs: int
    overhang: float
    """distance beyond the end, in half widths of the short side"""
    reach: float
    """standard deviations from a Gaussian's centre to its overhang"""
    copies: int


LADDERS = {
    LADDER: Ladder(ratio=2.0, pairs=5, overhang=0.03, reach=2.6, copies=1),
    # one copy would transmit 1 % between neighbours, and with an opacity ceiling of 0.99 also at its centre
    NESTED: Ladder(ratio=1.55, pairs=8, overhang=0.03, reach=CUT, copies=2),
}
"""Parameters by the number of Gaussians of a square."""


def nested_gaussians(aspect: float, ladder: Ladder) -> np.ndarray:
    """Template for an aspect ratio: (n, 5) float64 x, y, sigma_x, sigma_y, opacity in half sizes, the long
    side first."""
    pairs, overhang = ladder.pairs, ladder.overhang
    further = math.ceil(math.log(aspect) / math.log(ladder.ratio))
    along, across = _axis(ladder, pairs + further, overhang / aspect), _axis(ladder, pairs, overhang)
    rows = [
        (x, y, sx, sy, 1.0)
        for i, x, sx in along
        for j, y, sy in across
        # the smallest Gaussians, in the corners, need no copies
        for _ in range(1 if min(i, j) > pairs - 2 else ladder.copies)
    ]
    gaussians = np.array(rows)
    gaussians.flags.writeable = False
    return gaussians


def _axis(ladder: Ladder, pairs: int, overhang: float) -> list[tuple[int, float, float]]:
    """Step towards the ends, position and sigma of each Gaussian of an axis, in half lengths."""
    steps = [(k, ladder.ratio**-k, side) for k in range(1, pairs + 1) for side in (1, -1)]
    outer = [(k, side * (1 - d), (d + overhang) / ladder.reach) for k, d, side in steps]
    return [(0, 0.0, (1 + overhang) / ladder.reach), *outer]
