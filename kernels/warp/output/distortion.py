"""Depth distortion, the spread of a sample's fragments in depth: sum over pairs of w_i w_j (m_i - m_j)^2, m =
constant - INVERSE_DEPTH / z the depth in a depth buffer from 0.2 to 100 m (the 2DGS authors' loss). Depths
below 0.2 m are clamped to 0.2 m.

Computed as W sum w m^2 - (sum w m)^2, which does not depend on the origin of m; with the first fragment as
origin little cancels.
"""

from typing import Any

import warp as wp

from ..common import View, fma
from ..pixel_grid import PixelGrid, sample_at
from . import Output

INVERSE_DEPTH = wp.constant(0.2004008016032064)  # 0.2 * 100 / (100 - 0.2)
SPREAD_NEAR = wp.constant(0.2)


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    if weight > 0.0 and attributes.z > 0.0:
        inverse = INVERSE_DEPTH / wp.max(attributes.z, SPREAD_NEAR)
        if p.spread[1] == 0.0:
            p.spread[0] = inverse
        nearer = inverse - p.spread[0]
        p.spread[1] = p.spread[1] + weight
        p.spread[2] = fma(weight, nearer, p.spread[2])
        p.spread[3] = fma(weight * nearer, nearer, p.spread[3])
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.distortion[at] = pixel.spread


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    total = float(0.0)
    for k in range(grid.count):
        spread = samples.distortion[sample_at(grid, k)]
        total += spread[1] * spread[3] - spread[2] * spread[2]
    out.distortion[grid.pixel] = total * grid.mean


OUTPUT = Output(
    depth=True,
    state={
        "spread": wp.vec4
    },  # -m of the first fragment, sum w, sum w m, sum w m^2; m of sums relative to the first fragment
    composite=composite,
    samples={"distortion": wp.vec4},
    store=store,
    resolve=resolve,
)
