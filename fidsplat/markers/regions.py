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
    """
    import cv2

    dark, light = (
        cv2.connectedComponents((grid == value).astype(np.uint8), connectivity=4)[1] for value in (1, 0)
    )
    # one number per component: positive for dark components, negative for light ones
    _, first, labels = np.unique(dark - light, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[labels].reshape(grid.shape), len(first)


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
