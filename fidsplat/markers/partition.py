"""Minimum rectilinear partition of the components of both colours of a grid (Ferrari et al. 1984; the paper's
Algorithm 1).

All arithmetic is on integers. A *unit edge* of a grid line is between two neighbouring cells; it is interior
to a component if both cells have its colour. The four cells around an inner grid vertex determine its type:
three of one colour and one of the other make a concave vertex of the three (of outer boundaries and holes);
two and two on the diagonals make a checkerboard vertex, which is convex twice. Of the two horizontal unit
edges of a concave vertex exactly one is interior, and of the two vertical ones as well.

The axis-parallel chords of the paper are therefore the maximal runs of interior unit edges on a grid line
whose end vertices are both concave. One pass over the grid finds all of them without comparing pairs of
vertices. A vertex is on at most one horizontal and one vertical chord, so the conflicts (chords that cross or
share an end) are the vertices covered by both.

The maximum independent set of chords follows from a maximum matching by Koenig's theorem. Images of noise
have a million chords, nearly all in small trees. Vectorised rounds of the Karp-Sipser reduction, which match
a vertex to its only unmatched neighbour and keep the matching maximum, solve the trees. networkx's
Hopcroft-Karp matches the components with cycles.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np


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
    # edge above each module: 0 between a light and a dark one, 1 between light ones, 2 between dark ones
    edge = np.zeros((h + 1, w), np.int8)
    edge[1:-1] = np.where(grid[:-1] == grid[1:], grid[1:] + 1, 0)
    ends = np.ones((h + 1, w + 1), bool)
    ends[:, 1:-1] = edge[:, :-1] != edge[:, 1:]
    if cuts is not None:
        ends |= cuts
    line, start = np.nonzero(ends[:, :-1] & (edge > 0))
    stop = np.nonzero(ends[:, 1:] & (edge > 0))[1] + 1
    return Runs(line, start, stop, concave[line, start], concave[line, stop])


def chords(grid: np.ndarray, concave: np.ndarray) -> np.ndarray:
    """Horizontal chords (n, 3) of an (h, w) 0/1 grid: ints y, x0, x1, in raster order."""
    runs = interior_runs(grid, concave)
    both = runs.start_concave & runs.stop_concave
    return np.stack([runs.line[both], runs.start[both], runs.stop[both]], 1)


def _cover(cover: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Index of the horizontal chord that covers each vertex, ends included, or -1; int32 of shape `shape`."""
    owner = np.full(shape, -1, np.int32)
    length = cover[:, 2] - cover[:, 1] + 1
    which = np.repeat(np.arange(len(cover), dtype=np.int32), length)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(length) - length, length)
    owner[cover[which, 0], cover[which, 1] + offset] = which
    return owner


def independent_chords(grid: np.ndarray, concave: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maximum set of chords without conflicts.

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
    """Lower bound of the rectangles of a partition of an (h, w) uint8 0/1 grid, in one pass.

    The bound is a quarter of all corners, convex and concave: each independent chord ends at two concave
    corners and shares none, and convex - concave = 4 (components - holes).
    """
    dark = (grid[:-1, :-1] + grid[:-1, 1:]) + (grid[1:, :-1] + grid[1:, 1:])
    corners = 2 * np.count_nonzero(dark & 1)  # a concave one, and a convex one of the other colour
    corners += 4 * np.count_nonzero((dark == 2) & (grid[:-1, :-1] == grid[1:, 1:]))
    for edge in (grid[0], grid[-1], grid[:, 0], grid[:, -1]):
        corners += 2 * np.count_nonzero(edge[1:] != edge[:-1])
    return int(corners + 4) // 4


def partition(grid: np.ndarray) -> np.ndarray:
    """Minimum partition of every 4-connected component of an (h, w) uint8 0/1 grid into rectangles.

    Returns (n, 4) int64 rectangles x0, y0, x1, y1 in cells, half-open, in raster order of their first cell;
    the colour of rectangle i is `grid[y0, x0]`. They are disjoint, cover the grid, and their number is the
    minimum for each component: concave vertices - independent chords - holes + 1.

    After the independent chords, a cut starts at each remaining concave vertex and ends at the boundary or at
    another cut (the paper's greedy completion). All these cuts are horizontal and independent: parallel
    segments cannot cross, and none can connect two such vertices, because a chord without conflicts would be
    in the maximum set. The same rule yields the chosen horizontal chords, so that only the vertical ones are
    passed on.
    """
    h, w = grid.shape
    concave = concave_vertices(grid)
    _, down = independent_chords(grid, concave)

    cut = _cover(down, concave.shape[::-1]).T >= 0
    walls_x = np.ones((h, w + 1), bool)  # walls_x[y, x]: a cut on the left of cell (y, x)
    walls_x[:, 1:-1] = grid[:, :-1] != grid[:, 1:]
    line, along = _unit_edges(down[:, 0], down[:, 1], down[:, 2])
    walls_x[along, line] = True

    runs = interior_runs(grid, concave, cut)
    cuts = (runs.start_concave & ~cut[runs.line, runs.start]) | (
        runs.stop_concave & ~cut[runs.line, runs.stop]
    )
    walls_y = np.ones((h + 1, w), bool)  # walls_y[y, x]: a cut above cell (y, x)
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
    """Partition an (h, w) uint8 grid of colours into the minimum number of rectangles of one colour."""
    if grid.max() <= 1:
        return partition(grid)
    boxes = []
    for color in np.unique(grid):
        mask = (grid == color).astype(np.uint8)
        cut = partition(mask)
        boxes.append(cut[mask[cut[:, 1], cut[:, 0]] == 1])
    rectangles = np.concatenate(boxes)
    return rectangles[np.lexsort((rectangles[:, 0], rectangles[:, 1]))]


def merge_runs(grid: np.ndarray) -> np.ndarray:
    """Partition an (h, w) grid of any colours into rectangles: merge equal runs of successive rows, or of
    successive columns if that needs fewer rectangles; a few per cent more than the minimum.
    """
    across, down = _merged(grid), _merged(grid.T)[:, [1, 0, 3, 2]]
    return across if len(across) <= len(down) else down


def _merged(grid: np.ndarray) -> np.ndarray:
    """Runs of equal cells of the rows, merged with equal runs of the row above."""
    h, w = grid.shape
    edge = np.ones((h, w + 1), bool)
    edge[:, 1:-1] = grid[:, 1:] != grid[:, :-1]
    y, x0 = np.nonzero(edge[:, :-1])
    x1 = np.nonzero(edge[:, 1:])[1] + 1
    stop = np.zeros((h, w), np.int64)
    stop[y, x0] = x1
    continues = (y > 0) & (stop[y - 1, x0] == x1) & (grid[y - 1, x0] == grid[y, x0])
    order = np.argsort(x0 * h + y)
    first = np.flatnonzero(~continues[order])
    last = np.append(first[1:], len(order)) - 1
    top, bottom = order[first], order[last]
    return np.stack([x0[top], y[top], x1[top], y[bottom] + 1], 1)


def _unit_edges(line: np.ndarray, start: np.ndarray, stop: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit edges of segments on grid lines: lines and positions along them."""
    length = stop - start
    which = np.repeat(np.arange(len(length)), length)
    offset = np.arange(len(which)) - np.repeat(np.cumsum(length) - length, length)
    return line[which], start[which] + offset


ROUNDS = 64
"""Maximum number of vectorized rounds; few paths are longer."""

_limit = threading.Lock()


def maximum_independent_set(
    n_left: int, n_right: int, left: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximum independent set of a bipartite graph.

    left, right: (e,) vertices of each edge. Returns masks (n_left,) and (n_right,) bool.

    By Koenig's theorem the set has the left vertices on alternating paths from unmatched left vertices, and
    the right vertices without an edge to these. It does not depend on the choice of the maximum matching.
    """
    order = np.argsort(left, kind="stable")
    left, right = left[order], right[order]
    keep_left = _reached(left, right, *_matching(n_left, n_right, left, right))
    keep_right = np.ones(n_right, bool)
    keep_right[right[keep_left[left]]] = False
    return keep_left, keep_right


def _matching(
    n_left: int, n_right: int, left: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximum matching: partners of the left and of the right vertices, -1 for none."""
    of_left, of_right = np.full(n_left, -1), np.full(n_right, -1)
    for _ in range(ROUNDS):
        alone_left = np.bincount(left, minlength=n_left)[left] == 1
        single = np.flatnonzero(alone_left | (np.bincount(right, minlength=n_right)[right] == 1))
        if not len(single):
            break
        # Karp-Sipser reduction: match a vertex to one of its neighbours of degree 1
        shared = np.where(alone_left, right + n_left, left)[single]
        matched = single[np.unique(shared, return_index=True)[1]]
        of_left[left[matched]], of_right[right[matched]] = right[matched], left[matched]
        free = (of_left[left] < 0) & (of_right[right] < 0)
        left, right = left[free], right[free]
    if len(left):
        for u, v in _hopcroft_karp(left, right + n_left):
            of_left[u], of_right[v - n_left] = v - n_left, u
    return of_left, of_right


def _reached(left: np.ndarray, right: np.ndarray, of_left: np.ndarray, of_right: np.ndarray) -> np.ndarray:
    """Left vertices on alternating paths from unmatched left vertices, (n_left,) bool.

    left: sorted, so that the edges of a vertex are contiguous.
    """
    first = np.searchsorted(left, np.arange(len(of_left) + 1))
    reached = of_left < 0
    now = np.flatnonzero(reached)
    for _ in range(ROUNDS):
        count = first[now + 1] - first[now]
        edge = np.arange(count.sum()) + np.repeat(first[now] - (np.cumsum(count) - count), count)
        now = np.unique(of_right[right[edge]])  # all are matched, else the matching would not be maximum
        now = now[~reached[now]]
        if not len(now):
            return reached
        reached[now] = True
    todo = now.tolist()
    while todo:
        u = todo.pop()
        for v in of_right[right[first[u] : first[u + 1]]].tolist():
            if not reached[v]:
                reached[v] = True
                todo.append(v)
    return reached


def _hopcroft_karp(left: np.ndarray, right: np.ndarray) -> list[tuple[int, int]]:
    """Pairs of a maximum matching. Left and right vertices have disjoint numbers."""
    import networkx as nx  # here: the import takes longer than most markers

    graph = nx.Graph(zip(left.tolist(), right.tolist(), strict=True))
    lefts = set(left.tolist())
    # the recursion depth is the number of matched pairs on an augmenting path of a component
    with _recursion(max(map(len, nx.connected_components(graph)))):
        partner = nx.bipartite.hopcroft_karp_matching(graph, lefts)
    return [(u, v) for u, v in partner.items() if u in lefts]


@contextmanager
def _recursion(depth: int) -> Iterator[None]:
    """Raise the recursion limit temporarily, in one thread at a time: the limit is global."""
    with _limit:
        before = sys.getrecursionlimit()
        sys.setrecursionlimit(before + depth)
        try:
            yield
        finally:
            sys.setrecursionlimit(before)
