"""Bands of tiles: where they are cut."""

import numpy as np
import pytest

from fidsplat.backends.bands import cut


@pytest.mark.parametrize(
    ("most", "bands"),
    [
        (100, [(10, 15, 16)]),
        (7, [(10, 12, 7), (12, 14, 6), (14, 15, 3)]),
        (1, [(10, 11, 3), (11, 12, 4), (12, 13, 5), (13, 14, 1), (14, 15, 3)]),
    ],
)
def test_no_band_has_more_pairs_than_there_is_room_for(most, bands):
    """Unless one tile alone has more."""
    assert list(cut(np.array([3, 4, 5, 1, 3], np.uint32), most, start=10)) == bands


def test_many_bands_of_several_tiles_each():
    """The room is that of each band, not of the first alone."""
    assert [end - first for first, end, _ in cut(np.ones(100, np.uint32), 8)] == [8] * 12 + [4]
