"""Maximum independent set of the chords' conflict graph, by networkx: Hopcroft-Karp matching, then Koenig's
minimum vertex cover."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

_SOURCE = -1
_limit = threading.Lock()


def maximum_independent_set(
    n_left: int, n_right: int, left: np.ndarray, right: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The largest set of vertices of a bipartite graph no two of which are joined.

    left, right: (e,) the ends of each edge. Returns masks (n_left,) and (n_right,) bool.

    By Koenig's theorem the vertices reached from unmatched left vertices along alternating paths tell a
    minimum cover: the left ones not reached and the right ones reached; the set is the rest. It is the same
    for every maximum matching. One search from all unmatched vertices finds them; networkx's
    `to_vertex_cover` searches from each vertex anew, which takes quadratic time.
    """
    keep = np.ones(n_left + n_right, bool)
    if len(left):
        cover = _minimum_cover(list(zip(left.tolist(), (right + n_left).tolist(), strict=True)), n_left)
        keep[list(cover)] = False
    return keep[:n_left], keep[n_left:]


def _minimum_cover(edges: list[tuple[int, int]], n_left: int) -> set[int]:
    """Koenig's cover of a bipartite graph whose left vertices are those below ``n_left``."""
    import networkx as nx  # late: it takes longer to load than most markers to make

    graph = nx.Graph(edges)
    lefts = {vertex for vertex in graph if vertex < n_left}
    # it recurses once for each matched pair on an augmenting path, which stays within a component
    with _recursion(max(map(len, nx.connected_components(graph)))):
        partner = nx.bipartite.hopcroft_karp_matching(graph, lefts)
    # alternating paths are the directed ones: rightwards by unmatched edges, back by matched ones
    alternating = nx.DiGraph((b, a) if partner.get(a) == b else (a, b) for a, b in edges)
    alternating.add_edges_from((_SOURCE, vertex) for vertex in lefts - partner.keys())
    alternating.add_node(_SOURCE)
    reached = nx.descendants(alternating, _SOURCE)
    return (lefts - reached) | (reached - lefts)


@contextmanager
def _recursion(depth: int) -> Iterator[None]:
    """Room for that many more nested calls. One thread at a time: the limit is the interpreter's."""
    with _limit:
        before = sys.getrecursionlimit()
        sys.setrecursionlimit(before + depth)
        try:
            yield
        finally:
            sys.setrecursionlimit(before)
