"""Bands of tiles, for pictures with more pairs than there is room for."""

from itertools import pairwise

import numpy as np
import pytest

from fidsplat.backends.bands import cut

TOTALS = np.array([2, 0, 3, 1, 9, 0, 0, 1, 1, 2])
START = 5


@pytest.mark.parametrize("most", [1, 3, 7, 100])
def test_tiles_are_cut_into_as_few_bands_as_keep_the_budget(most):
    bands = list(cut(TOTALS, most, START))
    assert (bands[0][0], bands[-1][1]) == (START, START + len(TOTALS))
    assert all(end == first for (_, end, _), (first, _, _) in pairwise(bands))
    for first, end, pairs in bands:
        assert pairs == TOTALS[first - START : end - START].sum()
        assert pairs <= most or end == first + 1
    for _, end, pairs in bands[:-1]:
        assert pairs + TOTALS[end - START] > most
