"""Alpha: 1 - transmittance of all splats."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid, sample_at
from . import Output


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    t = float(0.0)
    for k in range(grid.count):
        t += samples.color[sample_at(grid, k)][3]
    out.alpha[grid.pixel] = 1.0 - t * grid.mean


OUTPUT = Output(resolve=resolve)
