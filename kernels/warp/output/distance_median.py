"""Median distance along the pixel's rays [m], from its samples' median depths."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid
from . import Output
from .depth_median import median_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    out.distance_median[grid.pixel] = median_of(grid, samples, lengths, True)


OUTPUT = Output(needs=("depth_median",), length=True, resolve=resolve)
