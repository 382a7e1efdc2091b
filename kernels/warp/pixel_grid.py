"""The samples of a pixel, and their indices in sample buffers."""

import warp as wp


@wp.struct
class PixelGrid:
    """The samples of one pixel."""

    pixel: int  # of the images, view after view, row by row
    here: int  # of the rendered views, view after view
    row: int  # of all views, one after the other
    splats: int  # of the cloud
    first: int  # place of the first sample in a buffer
    stride: int  # samples of a row of a buffer, its padding included
    side: int  # samples along a side
    count: int  # side^2
    mean: float  # 1 / count


@wp.func
def sample_at(grid: PixelGrid, k: int) -> int:
    """Index of sample k, 0 to count - 1, in a buffer."""
    return grid.first + k / grid.side * grid.stride + k % grid.side
