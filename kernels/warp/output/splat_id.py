"""Index of the splat with the largest weight; -1 without a visible splat."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid
from . import Output
from .heaviest import heaviest_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    out.splat_id[grid.pixel] = heaviest_of(grid, samples)


OUTPUT = Output(needs=("heaviest",), resolve=resolve)
