"""Growth against seams: rectangles reach into neighbours of their own colour, never into the other."""

import numpy as np


def grow(grid: np.ndarray, rectangles: np.ndarray, growth: float) -> np.ndarray:
    """Extend rectangles of an (h, w) 0/1 grid across those sides that lie wholly against their own colour.

    rectangles: (n, 4) ints x0, y0, x1, y1 in cells. growth: modules, 0 to 1. Returns (n, 4) float64. A
    mixture fades towards its edges, so two rectangles of one component leave a seam; where they overlap it
    closes. The rows of cells that a rectangle grows into, corners included, are checked to be of its
    colour.
    """
    h, w = grid.shape
    padded = np.full((h + 2, w + 2), 2, np.int8)  # 2: outside, nobody's colour
    padded[1:-1, 1:-1] = grid
    x0, y0, x1, y1 = (rectangles + 1).T
    color = padded[y0, x0]
    # sums[c, y, x]: cells of colour c above and left of the vertex
    sums = np.zeros((2, h + 3, w + 3), np.int64)
    for c in (0, 1):
        np.cumsum(np.cumsum(padded == c, 0), 1, out=sums[c, 1:, 1:])

    def own(left, top, right, bottom):
        count = sums[color, bottom, right] - sums[color, top, right]
        count -= sums[color, bottom, left] - sums[color, top, left]
        return count == (right - left) * (bottom - top)

    to_left, to_right = own(x0 - 1, y0, x0, y1), own(x1, y0, x1 + 1, y1)
    left, right = x0 - to_left, x1 + to_right
    up, down = own(left, y0 - 1, right, y0), own(left, y1, right, y1 + 1)
    return rectangles + growth * np.stack([-1 * to_left, -1 * up, to_right, down], 1)
