"""Maximum matching and maximum independent set of bipartite graphs."""

import numpy as np
import pytest

from fidsplat.markers.matching import maximum_independent_set, maximum_matching


def matching_size(n_left: int, neighbours: list[list[int]]) -> int:
    """Kuhn's algorithm, one augmenting path at a time: slow and short."""
    partner: dict[int, int] = {}

    def augment(u: int, seen: set[int]) -> bool:
        for v in neighbours[u]:
            if v not in seen:
                seen.add(v)
                if v not in partner or augment(partner[v], seen):
                    partner[v] = u
                    return True
        return False

    return sum(augment(u, set()) for u in range(n_left))


@pytest.mark.parametrize("seed", range(60))
def test_random_graphs(seed):
    rng = np.random.default_rng(seed)
    n, m = rng.integers(0, 30, 2)
    joined = np.argwhere(rng.random((n, m)) < rng.uniform(0.02, 0.4))
    neighbours = [joined[joined[:, 0] == u, 1].tolist() for u in range(n)]
    best = matching_size(n, neighbours)

    left, right = maximum_matching(n, m, neighbours)
    assert sum(v >= 0 for v in left) == best
    for u, v in enumerate(left):
        assert v < 0 or (v in neighbours[u] and right[v] == u)

    keep_left, keep_right = maximum_independent_set(n, m, joined[:, 0], joined[:, 1])
    assert keep_left.shape == (n,)
    assert keep_right.shape == (m,)
    assert keep_left.sum() + keep_right.sum() == n + m - best  # Koenig and Gallai
    assert not (keep_left[joined[:, 0]] & keep_right[joined[:, 1]]).any()


def test_augmenting_paths_as_long_as_the_graph():
    # a path that a greedy start matches wrongly all along; recursion would overflow the stack (networkx does)
    n = 20_000
    neighbours = [[0], *([u - 1, u] for u in range(1, n))]
    neighbours = neighbours[::-1]
    left, _ = maximum_matching(n, n, neighbours)
    assert min(left) >= 0


def test_no_vertices_and_no_edges():
    none = np.zeros(0, int)
    left, right = maximum_independent_set(0, 0, none, none)
    assert len(left) == len(right) == 0
    left, right = maximum_independent_set(3, 2, none, none)
    assert left.all()
    assert right.all()
