"""Connected components of a one-bit grid: 4-connected by colour, each with 8-connected holes.

The holes of a component are the bounded, 8-connected regions of its complement. The shapely polygons of
`polygons` are for geometry, figures and tests; no decision depends on them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from shapely import Polygon


def label_components(grid: np.ndarray) -> tuple[np.ndarray, int]:
    """4-connected components of equal cells of an (h, w) 0/1 grid.

    Returns (h, w) int32 labels, numbered from 0 in raster order of their first cell, and their count.
    Union-find joins runs of equal cells with the runs of the next row, vectorized over all pairs.
    """
    h, w = grid.shape
    starts = np.ones((h, w), bool)
    starts[:, 1:] = grid[:, 1:] != grid[:, :-1]
    run = (np.cumsum(starts.ravel()) - 1).reshape(h, w)
    below = grid[1:] == grid[:-1]
    # two runs may share several cells; keep the first of them
    fresh = below.copy()
    fresh[:, 1:] &= starts[1:, 1:] | starts[:-1, 1:] | ~below[:, :-1]
    a, b = run[:-1][fresh], run[1:][fresh]
    root = np.arange(int(run[-1, -1]) + 1)
    while True:
        ra, rb = root[a], root[b]
        apart = ra != rb
        if not apart.any():
            break
        a, b = a[apart], b[apart]
        low, high = np.minimum(ra, rb)[apart], np.maximum(ra, rb)[apart]
        np.minimum.at(root, high, low)
        while not np.array_equal(root[root], root):
            root = root[root]
    names, labels = np.unique(root, return_inverse=True)
    return labels.astype(np.int32)[run], len(names)


def polygons(grid: np.ndarray, labels: np.ndarray, count: int) -> list[Polygon]:
    """Shapely polygons with holes of the components of an (h, w) grid, in cells: x right, y down, from the
    top left.

    A component that touches itself at a corner has a hole that touches the shell, or two holes that touch, as
    the OGC rules for valid polygons require.
    """
    import shapely

    edge = np.ones((grid.shape[0], grid.shape[1] + 1), bool)
    edge[:, 1:-1] = grid[:, 1:] != grid[:, :-1]
    y, x0 = np.nonzero(edge[:, :-1])
    x1 = np.nonzero(edge[:, 1:])[1] + 1
    boxes = shapely.box(x0, y, x1, y + 1)
    owner = labels[y, x0]
    order = np.argsort(owner, kind="stable")
    parts = np.split(boxes[order], np.searchsorted(owner[order], np.arange(1, count)))
    unions = [shapely.union_all(part) for part in parts]
    return [union for union in shapely.simplify(unions, 0) if isinstance(union, shapely.Polygon)]
