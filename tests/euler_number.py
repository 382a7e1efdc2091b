"""Number of holes of the components of a grid, by Euler's formula."""

import numpy as np


def count_holes(labels: np.ndarray, count: int) -> np.ndarray:
    """8-connected holes of each component, (count,) int64, from its corners.

    A rectilinear boundary turns four times more one way than the other around each of its loops, so
    convex - concave = 4 (1 - holes), a checkerboard vertex counting as two convex ones.
    """
    padded = np.full((labels.shape[0] + 2, labels.shape[1] + 2), -1, np.int64)
    padded[1:-1, 1:-1] = labels
    # the four cells around every grid vertex: top left, top right, bottom left, bottom right
    cells = [padded[:-1, :-1], padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]]
    turns = np.zeros(count, np.int64)
    for i, own in enumerate(cells):
        left_right, above, diagonal = (cells[i ^ 1] == own), (cells[i ^ 2] == own), (cells[i ^ 3] == own)
        inside = own >= 0
        turns += np.bincount(own[inside & ~left_right & ~above], minlength=count)
        turns -= np.bincount(own[inside & left_right & above & ~diagonal], minlength=count)
    return 1 - turns // 4
