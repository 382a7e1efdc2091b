"""Label of the splat with the largest weight; -1 without a visible splat."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid
from . import Output
from .heaviest import heaviest_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    which = heaviest_of(grid, samples)
    label = int(-1)
    if which >= 0:
        label = out.labels[which]
    out.label[grid.pixel] = label


OUTPUT = Output(needs=("heaviest",), cloud_arrays={"labels": wp.int32}, resolve=resolve)
