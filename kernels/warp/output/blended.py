"""How many splats are composited: of a pixel the most of any of its samples."""

from typing import Any

import warp as wp

from ..common import View
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def see(seen: Any, numbers: float, index: int):
    s = seen
    s.blended = 1
    return s


@wp.func
def gather(layer: Any, seen: Any, tau: float):
    after = layer
    after.mean.blended = layer.mean.blended + seen.blended
    return after


@wp.func
def composite(pixel: Any, seen: Any, weight: float, shown: float, view: View):
    p = pixel
    p.blended += seen.blended
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
    seen={"blended": wp.int32},
    see=see,
    gather=gather,
    state={"blended": wp.int32},
    composite=composite,
    samples={"blended": wp.int32},
    store=store,
    resolve=resolve,
)
