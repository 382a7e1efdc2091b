"""Expected distance along the pixel's rays [m]: each sample's depth times the length of its ray."""

from typing import Any

import warp as wp

from ..common import fma
from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    along = float(0.0)
    weight = float(0.0)
    for k in range(grid.count):
        here = samples.depth[sample_at(grid, k)]
        along = fma(here[0], lengths[k], along)
        weight += here[1]
    out.distance[grid.pixel] = wp.where(weight > 0.0, along / weight, 0.0)


OUTPUT = Output(needs=("depth",), length=True, resolve=resolve)
