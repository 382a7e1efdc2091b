"""Splitting of frames into bands."""

import numpy as np
import pytest

from fidsplat.backends.ranges import split_by_cost


@pytest.mark.parametrize(
    ("most", "bands"),
    [
        (100, [(10, 15, 16)]),
        (7, [(10, 12, 7), (12, 14, 6), (14, 15, 3)]),
        (1, [(10, 11, 3), (11, 12, 4), (12, 13, 5), (13, 14, 1), (14, 15, 3)]),
    ],
)
def test_bands_keep_the_capacity(most, bands):
    """Except a single tile with more."""
    assert list(split_by_cost(np.array([3, 4, 5, 1, 3], np.uint32), most, start=10)) == bands


def test_many_bands_of_several_tiles_each():
    """The capacity applies to each band."""
    assert [end - first for first, end, _ in split_by_cost(np.ones(100, np.uint32), 8)] == [8] * 12 + [4]
