"""Expected depth along z [m]: the weighted mean of the fragments; 0 if none is visible."""

from typing import Any

import warp as wp

from ..common import View, fma
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    p.depth = fma(weight, attributes.z, p.depth)
    p.depth_weight += weight
    return p


@wp.func
def clear(pixel: Any):
    p = pixel
    p.depth = 0.0
    p.depth_weight = 0.0
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.depth[at] = wp.vec2(pixel.depth, pixel.depth_weight)


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    z = wp.vec2()
    for k in range(grid.count):
        z += samples.depth[sample_at(grid, k)]
    out.depth[grid.pixel] = wp.where(z[1] > 0.0, z[0] / z[1], 0.0)


OUTPUT = Output(
    depth=True,
    state={"depth": wp.float32, "depth_weight": wp.float32},
    composite=composite,
    clear=clear,
    samples={"depth": wp.vec2},  # sum w z, sum w
    store=store,
    resolve=resolve,
)
