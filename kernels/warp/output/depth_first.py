"""Depth of the first hit [m]: where the transmittance falls below the first-hit threshold. The minimum over
the samples of a pixel; 0 if no sample has a hit."""

from typing import Any

import warp as wp

from ..common import View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    if p.depth_first == 0.0 and p.t - weight <= view.first_hit_transmittance:
        p.depth_first = attributes.z
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.depth_first[at] = pixel.depth_first


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    nearest = float(wp.inf)
    for k in range(grid.count):
        hit = samples.depth_first[sample_at(grid, k)]
        if hit > 0.0:
            nearest = wp.min(nearest, hit)
    out.depth_first[grid.pixel] = wp.where(nearest < wp.inf, nearest, 0.0)


OUTPUT = Output(
    depth=True,
    state={"depth_first": wp.float32},
    composite=composite,
    samples={"depth_first": wp.float32},
    store=store,
    resolve=resolve,
)
