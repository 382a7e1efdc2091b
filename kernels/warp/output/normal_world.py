"""Unit normal towards the camera, in the axes of the world: each row of pixels is rotated by its pose."""

from typing import Any

import warp as wp

from ..pixel_grid import PixelGrid
from . import Output
from .normal import unit_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    turned = wp.transpose(out.row_rotations[grid.row]) * unit_of(grid, samples)
    for channel in range(3):
        out.normal_world[3 * grid.pixel + channel] = turned[channel]


OUTPUT = Output(
    needs=("normal",),
    view_arrays={"row_rotations": wp.mat33},  # (h) world to camera
    resolve=resolve,
)
