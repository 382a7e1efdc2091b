"""Growth of rectangles into neighbours of the same colour, against seams."""

import numpy as np

LONG = 0.6
"""A rectangle with a length of L modules along an axis grows by max(1, LONG * L) times the growth there."""


def grow(grid: np.ndarray, rectangles: np.ndarray, growth: float) -> np.ndarray:
    """Extend rectangles of an (h, w) 0/1 grid across the sides that border only their own colour.

    rectangles: (n, 4) ints x0, y0, x1, y1 in cells. growth: modules, 0 to 1, of short rectangles; `LONG` has
    the growth of longer ones. Returns (n, 4) float64.

    A mixture fades towards its edges, which leaves a seam between rectangles of a component unless they
    overlap. Templates are scaled, so long rectangles fade over a longer distance and need a larger overlap.
    All cells that a rectangle grows into, corners included, have its colour. The longer axis is extended
    first.
    """
    h, w = grid.shape
    padded = np.full((h + 2, w + 2), 2, np.int8)  # 2: outside of the grid
    padded[1:-1, 1:-1] = grid
    color = grid[rectangles[:, 1], rectangles[:, 0]]
    # sums[c, y, x]: cells of colour c above and left of the vertex of the padded grid
    sums = np.zeros((2, h + 3, w + 3), np.int64)
    for c in (0, 1):
        np.cumsum(np.cumsum(padded == c, 0), 1, out=sums[c, 1:, 1:])

    size = rectangles[:, 2:] - rectangles[:, :2]
    target = growth * np.maximum(1.0, LONG * size)
    cells = rectangles + 1  # cells that a rectangle intersects, in the padded grid
    grown = rectangles.astype(np.float64)
    first = (size[:, 1] > size[:, 0]).astype(np.int64)
    every = np.arange(len(size))
    for axis in (first, 1 - first):
        for end, way in ((0, -1), (2, 1)):
            left = target[every, axis]
            corner = cells[:, :2].copy()  # the first strip decides most cases
            corner[every, axis] = cells[every, axis + end] - (end == 0)
            moving = np.flatnonzero((left > 0) & (padded[corner[:, 1], corner[:, 0]] == color))
            while len(moving):
                side = axis[moving] + end
                each = np.arange(len(moving))
                strip = cells[moving]
                strip[each, axis[moving] + 2 - end] = strip[each, side]
                strip[each, side] += way
                x0, y0, x1, y1 = strip.T
                c = color[moving]
                own = sums[c, y1, x1] - sums[c, y0, x1] - sums[c, y1, x0] + sums[c, y0, x0]
                free = own == (x1 - x0) * (y1 - y0)
                moving, side = moving[free], side[free]
                cells[moving, side] += way
                grown[moving, side] += way * np.minimum(left[moving], 1.0)
                left[moving] -= 1.0
                moving = moving[left[moving] > 0]
    return grown
