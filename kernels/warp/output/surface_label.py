"""Label of the external depth image, if its surface has the largest weight. It changes the output `label`."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid, sample_at
from . import Output
from .heaviest import heaviest_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    weight = float(0.0)
    for k in range(grid.count):
        weight = wp.max(weight, samples.weight[sample_at(grid, k)])
    if weight > 0.0 and heaviest_of(grid, samples) < 0:
        out.label[grid.pixel] = out.external_label[grid.here % out.external_label.shape[0]]


OUTPUT = Output(needs=("heaviest",), view_arrays={"external_label": wp.int32}, resolve=resolve, over="label")
