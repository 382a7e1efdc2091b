"""Samples of a pixel, and their indices in sample buffers."""

import warp as wp


@wp.struct
class PixelGrid:
    """The samples of one pixel."""

    pixel: int  # index in the images, view after view, row by row
    here: int  # index in the rendered views, view after view
    row: int  # row of pixels, numbered over all views
    splats: int  # number of splats of the cloud
    first: int  # index of the first sample in a buffer
    stride: int  # samples per row of a buffer, padding included
    side: int  # samples along a side
    count: int  # side^2
    mean: float  # 1 / count


@wp.func
def sample_at(grid: PixelGrid, k: int) -> int:
    """Index of sample k, 0 to count - 1, in a buffer."""
    return grid.first + k / grid.side * grid.stride + k % grid.side
