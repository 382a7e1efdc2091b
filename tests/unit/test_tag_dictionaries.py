"""Tag dictionaries: every family, its grid, its ids, its bits."""

import cv2
import numpy as np
import pytest

from fidsplat.images.apriltag3 import LAYOUTS
from fidsplat.images.tag_dictionaries import dictionary_bits, families, parse_family
from fidsplat.util.errors import InputError


def test_every_predefined_dictionary_of_opencv_is_known():
    names = {n for n in dir(cv2.aruco) if n.startswith("DICT_")}
    values = {getattr(cv2.aruco, n) for n in names}
    assert len(families()) == len(values) + len(LAYOUTS)
    assert set(families("apriltag")) - set(LAYOUTS) == {"16h5", "25h9", "36h10", "36h11"}
    assert families()["36h11"] == (8, 587)
    assert families()["4x4_50"] == (6, 50)
    assert families()["7x7_1000"] == (9, 1000)


@pytest.mark.parametrize("family", [name for name in families() if name not in LAYOUTS])
def test_bits_are_the_printed_image(family):
    kind, _ = parse_family(family)
    size, count = families()[family]
    for tag_id in (0, count - 1):
        bits = dictionary_bits(kind, family, tag_id)
        assert bits.shape == (size, size)
        assert bits.dtype == np.uint8
        assert set(np.unique(bits)) == {0, 1}
        border = np.concatenate([bits[0], bits[-1], bits[:, 0], bits[:, -1]])
        assert border.all(), "the one-module border is dark"


def test_orientation_is_that_of_the_printed_apriltag():
    # the upper rows of tag 5 of 36h11, read off OpenCV's print
    rows = ["".join(map(str, row)) for row in dictionary_bits("apriltag", "36h11", 5)]
    assert rows[:4] == ["11111111", "11100101", "11000111", "10010101"]


@pytest.mark.parametrize(
    ("kind", "family", "tag_id", "says"),
    [
        ("apriltag", "tag36h12", 0, "36h11"),
        ("aruco", "36h11", 0, "aruco: 4x4_50"),
        ("barcode", "36h11", 0, "apriltag: 16h5"),
        ("apriltag", "36h11", 587, "0 to 586"),
        ("aruco", "4x4_50", -1, "0 to 49"),
    ],
)
def test_what_is_not_there_is_an_error_that_names_what_is(kind, family, tag_id, says):
    with pytest.raises(InputError, match=says):
        dictionary_bits(kind, family, tag_id)


def test_a_family_is_named_with_or_without_its_kind():
    assert parse_family("36h11") == parse_family("apriltag:36h11") == ("apriltag", "36h11")
    with pytest.raises(InputError):
        parse_family("aruco:36h11")
    with pytest.raises(InputError, match="kind of tag must be one of"):
        families("qr")
