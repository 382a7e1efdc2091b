"""Maximum independent set of the chords' conflict graph: a maximum matching, then Koenig's theorem.

Images of noise have a million chords, nearly all in small trees. A vertex with one unmatched neighbour is
matched to it, which keeps the matching maximum; vectorized rounds of this solve the trees. networkx's
Hopcroft-Karp matches the rest, which has cycles.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

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
