"""Number of composited splats: the maximum over the samples of a pixel."""

from typing import Any

import warp as wp

from ..common import View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def read_attributes(attributes: Any, numbers: float, index: int):
    s = attributes
    s.blended = 1
    return s


@wp.func
def accumulate(layer: Any, attributes: Any, tau: float, share: float):
    after = layer
    after.mean.blended = layer.mean.blended + attributes.blended
    return after


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    p.blended += attributes.blended
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.blended[at] = pixel.blended


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    count = int(0)
    for k in range(grid.count):
        count = wp.max(count, samples.blended[sample_at(grid, k)])
    out.blended[grid.pixel] = count


OUTPUT = Output(
    attributes={"blended": wp.int32},
    read_attributes=read_attributes,
    accumulate=accumulate,
    state={"blended": wp.int32},
    composite=composite,
    samples={"blended": wp.int32},
    store=store,
    resolve=resolve,
)
