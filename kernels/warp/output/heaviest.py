"""Splat with the largest weight, read by `label` and `splat_id`; -1 for none, or if the external depth image
has the largest weight. It has no output image."""

from typing import Any

import warp as wp

from ..common import View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def read_attributes(attributes: Any, numbers: float, index: int):
    s = attributes
    s.heaviest = index
    return s


@wp.func
def accumulate(layer: Any, attributes: Any, tau: float, share: float):
    after = layer
    if tau > layer.thickest:
        after.thickest = tau
        after.mean.heaviest = attributes.heaviest
    return after


@wp.func
def start(pixel: Any, length: float, view: View):
    p = pixel
    p.heaviest = -1
    return p


@wp.func
def composite(pixel: Any, attributes: Any, weight: float, view: View):
    p = pixel
    if weight > p.weight:
        p.weight = weight
        p.heaviest = attributes.heaviest
    return p


@wp.func
def cover(attributes: Any):
    s = attributes
    s.heaviest = -1
    return s


@wp.func
def clear(pixel: Any):
    p = pixel
    p.weight = 0.0
    return p


@wp.func
def store(pixel: Any, at: int, samples: Any):
    samples.heaviest[at] = pixel.heaviest
    samples.weight[at] = pixel.weight


@wp.func
def heaviest_of(grid: PixelGrid, samples: Any) -> int:
    """Index in the cloud of the splat with the largest weight over the samples of the pixel."""
    weight = float(0.0)
    which = int(-1)
    for k in range(grid.count):
        at = sample_at(grid, k)
        if samples.weight[at] > weight:
            weight = samples.weight[at]
            which = samples.heaviest[at]
    if which >= 0:
        which = which % grid.splats
    return which


OUTPUT = Output(
    # splat index among all views; for a layer, the splat of largest optical depth
    attributes={"heaviest": wp.int32},
    read_attributes=read_attributes,
    layer={"thickest": wp.float32},
    accumulate=accumulate,
    state={"weight": wp.float32, "heaviest": wp.int32},
    start=start,
    composite=composite,
    cover=cover,
    clear=clear,
    samples={"heaviest": wp.int32, "weight": wp.float32},
    store=store,
)
