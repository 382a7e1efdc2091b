"""Minimum rectilinear partition of both colours of a grid at once (Ferrari et al. 1984; the paper's
Algorithm 1).

Every decision is made on integers. A grid line's *unit edge* is between two neighbouring cells and is
interior to a component when both cells have its colour. At an inner grid vertex the four cells around it say
everything: three of one colour and one of the other is a concave vertex of the three (outer boundary or hole
alike); two and two on the diagonal is a checkerboard vertex, convex twice and concave for none. Exactly one
of a concave vertex's two horizontal unit edges is interior, and exactly one of its two vertical ones.

So the axis-parallel chords of the paper are simply those maximal runs of interior unit edges on a grid line
whose two end vertices are both concave: all of them come out of one pass over the grid, no pair of vertices
is ever compared, and a chord between vertices that are not neighbours on their line cannot arise. A vertex
is on at most one horizontal and at most one vertical chord, so the pairs that conflict (cross, or share
an end) are the vertices covered by both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fidsplat.markers.conflicts import maximum_independent_set


class Runs(NamedTuple):
    """Maximal runs of interior unit edges along horizontal grid lines; ``n`` runs in raster order.

    line: (n,) grid line y, between cell rows y-1 and y. start, stop: (n,) end vertices x, start < stop.
    start_concave, stop_concave: (n,) bool, whether the end vertex is concave.
    """

    line: np.ndarray
    start: np.ndarray
    stop: np.ndarray
    start_concave: np.ndarray
    stop_concave: np.ndarray


def concave_vertices(grid: np.ndarray) -> np.ndarray:
    """Concave vertices of all components of an (h, w) 0/1 grid: (h+1, w+1) bool, indexed [y, x]."""
    h, w = grid.shape
    concave = np.zeros((h + 1, w + 1), bool)
    dark = (grid[:-1, :-1] + grid[:-1, 1:]) + (grid[1:, :-1] + grid[1:, 1:])
    concave[1:-1, 1:-1] = (dark & 1) == 1
    return concave


def interior_runs(grid: np.ndarray, concave: np.ndarray, cuts: np.ndarray | None = None) -> Runs:
    """Maximal runs of interior unit edges on the horizontal grid lines of an (h, w) 0/1 grid.

    cuts: (h+1, w+1) bool, vertices at which a run ends because a vertical chord passes through them.
    """
    h, w = grid.shape
    edge = np.zeros((h + 1, w), np.int8)  # 0: boundary, 1 or 2: interior to a light or a dark component
    edge[1:-1] = np.where(grid[:-1] == grid[1:], grid[1:] + 1, 0)
    ends = np.ones((h + 1, w + 1), bool)
    ends[:, 1:-1] = edge[:, :-1] != edge[:, 1:]
    if cuts is not None:
        ends |= cuts
    line, start = np.nonzero(ends[:, :-1] & (edge > 0))
    stop = np.nonzero(ends[:, 1:] & (edge > 0))[1] + 1
    return Runs(line, start, stop, concave[line, start], concave[line, stop])


def chords(grid: np.ndarray, concave: np.ndarray) -> np.ndarray:
    """Horizontal chords of an (h, w) 0/1 grid: (n, 3) ints y, x0, x1, in raster order."""
    runs = interior_runs(grid, concave)
    both = runs.start_concave & runs.stop_concave
    return np.stack([runs.line[both], runs.start[both], runs.stop[both]], 1)


def _cover(found: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """For every vertex the horizontal chord that covers it, ends included, or -1: ``shape`` int32."""
    owner = np.full(shape, -1, np.int32)
    length = found[:, 2] - found[:, 1] + 1
    which = np.repeat(np.arange(len(found), dtype=np.int32), length)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(length) - length, length)
    owner[found[which, 0], found[which, 1] + offset] = which
    return owner


def independent_chords(grid: np.ndarray, concave: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A maximum set of chords no two of which meet.

    Returns (n, 3) horizontal chords y, x0, x1 and (m, 3) vertical chords x, y0, y1. The conflicts form a
    bipartite graph; its maximum matching gives a minimum vertex cover (Koenig), and the rest is the
    independent set.
    """
    across = chords(grid, concave)
    down = chords(grid.T, concave.T)
    over_across = _cover(across, concave.shape)
    over_down = _cover(down, concave.shape[::-1]).T
    both = (over_across >= 0) & (over_down >= 0)
    keep_across, keep_down = maximum_independent_set(
        len(across), len(down), over_across[both], over_down[both]
    )
    return across[keep_across], down[keep_down]


def minimum_rectangles(grid: np.ndarray) -> int:
    """A number of rectangles below which no partition of an (h, w) uint8 0/1 grid comes, from one look at it.

    Of all components' corners, convex and concave, it is a quarter: independent chords end at two concave
    corners each and share none, and convex - concave = 4 (components - holes).
    """
    dark = (grid[:-1, :-1] + grid[:-1, 1:]) + (grid[1:, :-1] + grid[1:, 1:])
    corners = 2 * np.count_nonzero(dark & 1)  # one concave, and one convex of the other colour
    corners += 4 * np.count_nonzero((dark == 2) & (grid[:-1, :-1] == grid[1:, 1:]))
    for edge in (grid[0], grid[-1], grid[:, 0], grid[:, -1]):
        corners += 2 * np.count_nonzero(edge[1:] != edge[:-1])
    return int(corners + 4) // 4


def partition(grid: np.ndarray) -> np.ndarray:
    """Minimum partition of every 4-connected component of an (h, w) uint8 0/1 grid into rectangles.

    Returns (n, 4) int64 rectangles x0, y0, x1, y1 in cells, half-open, in raster order of their first cell;
    the colour of rectangle i is ``grid[y0, x0]``. Disjoint, exactly covering, and per component of the
    minimum number: concave vertices - independent chords - holes + 1.

    After the independent chords, each concave vertex that none of them ends at sends one segment into its
    component until it meets the boundary or an earlier cut (the paper's greedy completion). Sent
    horizontally, all of them at once: parallel segments cannot cross, and none can join two such vertices,
    because a chord that meets no vertical one of a maximum set would be in the set. The chosen horizontal
    chords are cut by the same rule, so only the vertical ones need to be known.
    """
    h, w = grid.shape
    concave = concave_vertices(grid)
    _, down = independent_chords(grid, concave)

    cut = _cover(down, concave.shape[::-1]).T >= 0
    walls_x = np.ones((h, w + 1), bool)  # walls_x[y, x]: a wall on the left of cell (y, x)
    walls_x[:, 1:-1] = grid[:, :-1] != grid[:, 1:]
    line, along = _unit_edges(down[:, 0], down[:, 1], down[:, 2])
    walls_x[along, line] = True

    runs = interior_runs(grid, concave, cut)
    cuts = (runs.start_concave & ~cut[runs.line, runs.start]) | (
        runs.stop_concave & ~cut[runs.line, runs.stop]
    )
    walls_y = np.ones((h + 1, w), bool)  # walls_y[y, x]: a wall above cell (y, x)
    walls_y[1:-1] = grid[:-1] != grid[1:]
    line, along = _unit_edges(runs.line[cuts], runs.start[cuts], runs.stop[cuts])
    walls_y[line, along] = True

    y0, x0 = np.nonzero(walls_y[:-1] & walls_x[:, :-1])
    right = np.flatnonzero(walls_x[:, 1:])
    below = np.flatnonzero(walls_y[1:].T)
    x1 = right[np.searchsorted(right, y0 * w + x0)] - y0 * w + 1
    y1 = below[np.searchsorted(below, x0 * h + y0)] - x0 * h + 1
    return np.stack([x0, y0, x1, y1], 1)


def partition_colors(grid: np.ndarray) -> np.ndarray:
    """The same as `partition` for an (h, w) uint8 grid of any number of colours."""
    if grid.max() <= 1:
        return partition(grid)
    boxes = []
    for color in np.unique(grid):
        own = (grid == color).astype(np.uint8)
        cut = partition(own)
        boxes.append(cut[own[cut[:, 1], cut[:, 0]] == 1])
    found = np.concatenate(boxes)
    return found[np.lexsort((found[:, 0], found[:, 1]))]


def _unit_edges(line: np.ndarray, start: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The unit edges of segments on grid lines: their lines and their positions along them."""
    length = stop - start
    which = np.repeat(np.arange(len(length)), length)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(length) - length, length)
    return line[which], start[which] + offset
