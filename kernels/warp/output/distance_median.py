"""Median distance along the pixel's rays [m], from its samples' median depths."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid, sample_at
from . import Output
from .depth_median import middle_of, sorted_in


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    medians = type(lengths)()
    hits = int(0)
    for k in range(grid.count):
        half = samples.depth_median[sample_at(grid, k)]
        if half > 0.0:
            medians = sorted_in(medians, hits, half * lengths[k])
            hits += 1
    out.distance_median[grid.pixel] = middle_of(medians, hits)


OUTPUT = Output(needs=("depth_median",), length=True, resolve=resolve)
