"""Distance to the first hit along the pixel's rays [m]: the minimum over its samples."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    nearest = float(wp.inf)
    for k in range(grid.count):
        hit = samples.depth_first[sample_at(grid, k)]
        if hit > 0.0:
            nearest = wp.min(nearest, hit * lengths[k])
    out.distance_first[grid.pixel] = wp.where(nearest < wp.inf, nearest, 0.0)


OUTPUT = Output(needs=("depth_first",), length=True, resolve=resolve)
