"""Mean squared distance of points to their three nearest neighbours, by the leaves of a k-d tree."""

from __future__ import annotations

import numpy as np

_LEAF = 256
_NEAREST = 3
_PAIRS = 1 << 22
"""maximum number of pairs of points in one array operation"""


def mean_square_distances(points: np.ndarray) -> np.ndarray:
    """Mean squared distance (n,) float64 of each point (n, 3) to its three nearest neighbours; 0 for a
    single point.

    Each leaf of a k-d tree has at most 256 points. Its points are compared with the points of all leaves that
    are closer than the largest distance to a third neighbour inside the leaf.
    """
    points = np.asarray(points, np.float64)
    if len(points) < 2:
        return np.zeros(len(points))
    boxes = _boxes(points)
    low = np.array([points[box].min(0) for box in boxes])
    high = np.array([points[box].max(0) for box in boxes])
    distances = np.zeros(len(points))
    for number, box in enumerate(boxes):
        mine = points[box]
        nearest = _nearest(mine, mine)
        max_distance = nearest[:, -1].max() if nearest.shape[1] == _NEAREST else np.inf
        gap = np.maximum(np.maximum(low - high[number], low[number] - high), 0)
        near = np.flatnonzero((gap * gap).sum(1) <= max_distance)
        if len(near) > 1:
            nearest = _nearest(mine, points[np.concatenate([boxes[k] for k in near])])
        distances[box] = nearest.mean(1)
    return distances


def _boxes(points: np.ndarray) -> list[np.ndarray]:
    """Indices of the points of each leaf. Boxes are halved along their longest side until they are small."""
    todo, done = [np.arange(len(points))], []
    while todo:
        box = todo.pop()
        if len(box) <= _LEAF:
            done.append(box)
            continue
        axis = np.argmax(np.ptp(points[box], axis=0))
        order = box[np.argsort(points[box, axis], kind="stable")]
        todo += [order[len(order) // 2 :], order[: len(order) // 2]]
    return done


def _nearest(mine: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Sorted squared distances (n, at most 3) to the nearest points of `among`, which contains `mine`."""
    count = min(_NEAREST + 1, len(among))
    nearest = np.empty((len(mine), count))
    step = max(1, _PAIRS // len(among))  # a box of outliers may be compared with all others
    for first in range(0, len(mine), step):
        part = slice(first, first + step)
        squares = np.zeros((len(mine[part]), len(among)))
        for axis in range(3):
            squares += (mine[part, None, axis] - among[None, :, axis]) ** 2
        squares.partition(count - 1, axis=1)
        nearest[part] = squares[:, :count]
    nearest.sort(axis=1)
    return nearest[:, 1:]  # the first is the point itself
