"""Maximum independent sets of bipartite graphs."""

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from fidsplat.markers.partition import maximum_independent_set


def matching(n_left: int, neighbours: list[list[int]]) -> dict[int, int]:
    """Kuhn's algorithm, one augmenting path at a time: slow and short. Partners of right vertices."""
    partner: dict[int, int] = {}

    def augment(u: int, seen: set[int]) -> bool:
        for v in neighbours[u]:
            if v not in seen:
                seen.add(v)
                if v not in partner or augment(partner[v], seen):
                    partner[v] = u
                    return True
        return False

    for u in range(n_left):
        augment(u, set())
    return partner


@pytest.mark.parametrize("seed", range(60))
def test_random_graphs(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 30, 2)
    joined = np.argwhere(rng.random((n, m)) < rng.uniform(0.02, 0.4))
    neighbours = [joined[joined[:, 0] == u, 1].tolist() for u in range(n)]
    partner = matching(n, neighbours)

    keep_left, keep_right = maximum_independent_set(n, m, joined[:, 0], joined[:, 1])
    assert keep_left.shape == (n,)
    assert keep_right.shape == (m,)
    assert keep_left.sum() + keep_right.sum() == n + m - len(partner)  # Koenig and Gallai
    assert not (keep_left[joined[:, 0]] & keep_right[joined[:, 1]]).any()

    # of the largest sets the one that alternating paths from unmatched left vertices tell
    reached, todo = set(), set(range(n)) - set(partner.values())
    while todo:
        reached |= todo
        todo = {partner[v] for u in todo for v in neighbours[u]} - reached
    assert np.flatnonzero(keep_left).tolist() == sorted(reached)
    beyond = {v for u in reached for v in neighbours[u]}
    assert np.flatnonzero(~keep_right).tolist() == sorted(beyond)


def path(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges of a path of 2 n vertices in an order that leads to one augmenting path along all of it."""
    u = np.arange(n)
    left, right = np.concatenate([u, u[1:]]), np.concatenate([u, u[1:] - 1])
    return (n - 1 - left)[::-1], right[::-1]


def test_a_path_of_200_000_vertices():
    """Deeper than Python's stack may be by default; the limit is put back."""
    limit = sys.getrecursionlimit()
    n = 100_000
    keep_left, keep_right = maximum_independent_set(n, n, *path(n))
    assert keep_left.sum() + keep_right.sum() == n
    assert sys.getrecursionlimit() == limit


def test_long_alternating_paths_are_followed_to_their_end():
    """A path with one more left vertex: the largest set is the left ones, whichever of them is unmatched."""
    n = 5000
    left, right = path(n)
    keep_left, keep_right = maximum_independent_set(n + 1, n, np.append(left, n), np.append(right, n - 1))
    assert keep_left.all()
    assert not keep_right.any()


def test_trees_need_no_search(monkeypatch):
    """Random forests and stars are matched from their leaves, thousands at once."""
    monkeypatch.setattr("fidsplat.markers.partition._hopcroft_karp", None)
    n = 3000
    right = np.arange(n) // 3  # stars of three
    keep_left, keep_right = maximum_independent_set(n, n, np.arange(n), right)
    assert keep_left.all()
    assert keep_right.sum() == n - n // 3


def test_threads_keep_the_limit():
    limit = sys.getrecursionlimit()
    with ThreadPoolExecutor(4) as pool:
        actual = list(pool.map(lambda n: maximum_independent_set(n, n, *path(n)), [3000, 2000, 1500, 2500]))
    assert [a.sum() + b.sum() for a, b in actual] == [3000, 2000, 1500, 2500]
    assert sys.getrecursionlimit() == limit


def test_no_vertices_and_no_edges():
    none = np.zeros(0, int)
    left, right = maximum_independent_set(0, 0, none, none)
    assert len(left) == len(right) == 0
    left, right = maximum_independent_set(3, 2, none, none)
    assert left.all()
    assert right.all()
