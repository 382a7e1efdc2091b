"""Unit normal towards the camera, in the axes of the world: each row of pixels is rotated by its pose."""

from typing import Any

import warp as wp

from ..common import fma_dot
from ..pixel_grid import PixelGrid
from . import Output
from .normal import sum_of


@wp.func
def resolve(grid: PixelGrid, samples: Any, lengths: Any, out: Any):
    sum, scale = sum_of(grid, samples)
    to_world = wp.transpose(out.row_rotations[grid.row])
    for axis in range(3):
        out.normal_world[3 * grid.pixel + axis] = scale * fma_dot(to_world[axis], sum)


OUTPUT = Output(
    needs=("normal",),
    view_arrays={"row_rotations": wp.mat33},  # (h) world to camera
    resolve=resolve,
)
