"""A pixel of the picture as a window of the sample grid."""

import warp as wp


@wp.struct
class Window:
    """The samples of one pixel."""

    pixel: int  # of the picture, row by row
    row: int  # of the picture
    first: int  # place of the first sample in a buffer
    stride: int  # samples of a row of a buffer, its padding included
    side: int  # samples along a side
    count: int  # side^2
    mean: float  # 1 / count


@wp.func
def sample_at(window: Window, k: int) -> int:
    """Where sample k, 0 to count - 1, lies in a buffer."""
    return window.first + k / window.side * window.stride + k % window.side
