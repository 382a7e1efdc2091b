"""Mixtures: the paper's, the fitted ones, their place in rectangles, and growth against seams."""

import random
import string

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fidsplat.capture.quality import TEMPLATE_SIZES
from fidsplat.images.tag_dictionaries import dictionary_bits, families
from fidsplat.markers.kinds import bits_of, parse_spec
from fidsplat.markers.mixture import (
    OVERLAP,
    Template,
    fitted_growth,
    fitted_templates,
    paper_template,
    place,
    split_rectangles,
)
from fidsplat.markers.partition import partition
from fidsplat.markers.printing import LONG, grow
from fidsplat.util.errors import InputError


@pytest.mark.parametrize("levels", range(1, 9))
def test_counts_of_the_paper(levels):
    """The two readings of "mirror across the axes", at density 1."""
    assert len(paper_template(levels, 1)) == 2 ** (levels + 2) - 7
    literal = 1 if levels == 1 else 2 ** (levels + 2) + 4 * levels - 11
    assert len(paper_template(levels, 1, duplicates=True)) == literal


def test_density_repeats_all_levels_but_the_last():
    assert len(paper_template(4, 3)) == 107
    assert len(paper_template(4, 3, duplicates=True)) == 3 * 33 + 36
    assert len(paper_template(1, 3)) == 1
    rows, times = np.unique(paper_template(4, 3), axis=0, return_counts=True)
    finest = np.isclose(rows[:, 2:4].min(1), 1 / 24)
    assert (times[finest] == 1).all()
    assert (times[~finest] == 3).all()
    rows, times = np.unique(paper_template(3, 1, duplicates=True), axis=0, return_counts=True)
    on_axis = (rows[:, :2] == 0).any(1) & (rows[:, :2] != 0).any(1)
    assert (times[on_axis] == 2).all()
    assert (times[~on_axis] == 1).all()


def test_the_paper_s_numbers_at_two_and_three_levels():
    """Section 3.2, by hand: d_1 = 1/2, d_2 = 3/4; sigma = 1/(3 2^l); along an arm (1 - o)/3."""
    two = {tuple(row) for row in np.round(paper_template(2, 1), 9)}
    third, sixth = round(1 / 3, 9), round(1 / 6, 9)
    assert two == {
        (0, 0, third, third, 1),
        *((sx * 0.5, sy * 0.5, sixth, sixth, 1) for sx in (1, -1) for sy in (1, -1)),
        *((0, s * 0.5, third, sixth, 1) for s in (1, -1)),
        *((s * 0.5, 0, sixth, third, 1) for s in (1, -1)),
    }
    three = paper_template(3, 1)
    arm = three[np.isclose(three[:, 1], 0.75) & np.isclose(three[:, 0], 0.375)]
    assert np.allclose(arm, [[0.375, 0.75, 0.625 / 3, 1 / 12, 1]])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"levels": 0}, "levels must be .* got 0"),
        ({"levels": 9}, "1 to 8"),
        ({"levels": 2.5}, "whole number"),
        ({"density": 0}, "density must be .* got 0"),
        ({"density": float("nan")}, "density must be .* got nan"),
        ({"density": "many"}, "density must be .* got 'many'"),
    ],
)
def test_options_of_the_paper_s_mixture(options, says):
    with pytest.raises(InputError, match=says):
        paper_template(**options)


def all_templates():
    return [*(template.gaussians for template in fitted_templates()), paper_template(4, 3)]


@pytest.mark.parametrize("gaussians", all_templates(), ids=["short", "middle", "long", "paper"])
def test_templates_are_symmetric_and_drawable(gaussians):
    for axis in (0, 1):
        mirrored = gaussians.copy()
        mirrored[:, axis] *= -1
        assert np.array_equal(*(np.unique(t + 0.0, axis=0) for t in (gaussians, mirrored)))
    assert (gaussians[:, 2:4] > 0).all()
    assert ((gaussians[:, 4] > 0) & (gaussians[:, 4] <= 1)).all()
    assert (np.abs(gaussians[:, :2]) <= 1).all()


def counts(grid: np.ndarray) -> tuple[int, int]:
    """Gaussians of the fitted mixture, and of the paper's at L = 4, rho = 3."""
    boxes = partition(grid)
    aspect = (boxes[:, 2] - boxes[:, 0]) / (boxes[:, 3] - boxes[:, 1])
    return len(place(boxes.astype(float), aspect, fitted_templates())[1]), 107 * len(boxes)


@pytest.mark.parametrize("version", [2, 5, 10, 22])
def test_fitted_takes_at_most_a_quarter_of_the_paper_s_gaussians_on_qr_codes(version):
    length = {2: 20, 5: 100, 10: 250, 22: 1000}[version]
    for seed in range(3):
        text = "".join(random.Random(seed).choices(string.ascii_letters + string.digits, k=length))
        fitted, paper = counts(np.pad(bits_of(parse_spec(f"qr-v{version}-L:{text}"))[1], 4))
        assert 4 * fitted <= paper


def test_fitted_takes_at_most_a_quarter_of_the_paper_s_gaussians_on_every_36h11():
    for i in range(587):
        fitted, paper = counts(np.pad(dictionary_bits("apriltag", "36h11", i), 1))
        assert 4 * fitted <= paper


def test_fitted_takes_little_more_than_a_quarter_on_any_tag():
    """Only tags of very few rectangles, most of them long bars, go beyond a quarter."""
    for kind in ("apriltag", "aruco"):
        for family, (_, count) in families(kind).items():
            for i in range(0, count, max(1, count // 40)):
                fitted, paper = counts(np.pad(dictionary_bits(kind, family, i), 1))
                assert fitted <= 0.28 * paper


def test_place_scales_a_template_along_the_longer_side():
    short = np.array([[0.5, 0.25, 0.1, 0.2, 0.7]])
    long = np.array([[-1.0, 0.0, 0.3, 0.4, 1.0], [1.0, 0.0, 0.3, 0.4, 1.0]])
    templates = (Template(2.0, short), Template(np.inf, long))
    boxes = np.array([[0, 0, 4, 2], [10, 20, 12, 24], [0, 0, 6, 2], [0, 0, 2, 8], [0, 0, 2, 2]], float)
    aspect = np.array([2, 0.5, 3, 0.25, 1])
    gaussians, owner = place(boxes, aspect, templates)
    assert owner.tolist() == [0, 1, 2, 2, 3, 3, 4]
    assert np.allclose(
        gaussians,
        [
            [3, 1.25, 0.2, 0.2, 0.7],
            [11.25, 23, 0.2, 0.2, 0.7],
            [0, 1, 0.9, 0.4, 1],
            [6, 1, 0.9, 0.4, 1],
            [1, 0, 0.4, 1.2, 1],
            [1, 8, 0.4, 1.2, 1],
            [1.5, 1.25, 0.1, 0.2, 0.7],
        ],
    )


def test_long_rectangles_are_cut_into_equal_pieces_that_overlap():
    boxes = np.array([[0, 0, 24, 2], [5, 1, 6, 5], [0, 0, 2, 10], [0, 0, 9, 2]], float)
    pieces, aspect, owner = split_rectangles(boxes, np.array([12, 0.25, 0.2, 4.5]), 4.0)
    assert owner.tolist() == [0, 0, 0, 1, 2, 2, 3, 3]
    assert OVERLAP == 0.2  # as docs/markers.md says; the shipped templates were fitted with it
    reach = 2 * OVERLAP
    lying = [[0, 0, 8 + reach, 2], [8 - reach, 0, 16 + reach, 2], [16 - reach, 0, 24, 2]]
    upright = [[0, 0, 2, 5 + reach], [0, 5 - reach, 2, 10]]
    assert np.allclose(pieces, [*lying, boxes[1], *upright, [0, 0, 4.5 + reach, 2], [4.5 - reach, 0, 9, 2]])
    assert np.allclose(aspect, [4, 4, 4, 0.25, 0.4, 0.4, 2.25, 2.25])


@pytest.mark.parametrize("size", TEMPLATE_SIZES)
def test_no_template_is_stretched_beyond_what_it_was_fitted_for(size):
    templates = fitted_templates(size)
    longest = templates[-1].max_aspect
    boxes = np.array([[0, 0, length, 1] for length in (longest, longest + 1, 100)], float)
    _, owner = place(boxes, boxes[:, 2], templates)
    parts = [1, 2, np.ceil(100 / longest)]
    kinds = [np.searchsorted([t.max_aspect for t in templates], boxes[i, 2] / n) for i, n in enumerate(parts)]
    assert np.bincount(owner).tolist() == [
        n * len(templates[kind].gaussians) for n, kind in zip(parts, kinds, strict=True)
    ]


def grown_by_definition(grid: np.ndarray, box: list[int], growth: float) -> list[float]:
    """Expected result of `grow` for one rectangle, computed cell by cell."""
    own = grid[box[1], box[0]]
    lengths = (box[2] - box[0], box[3] - box[1])
    cells, grown = list(box), [float(edge) for edge in box]
    for axis in (1, 0) if lengths[1] > lengths[0] else (0, 1):
        expected = growth * max(1.0, LONG * lengths[axis])
        for side, way in ((axis, -1), (axis + 2, 1)):
            free = 0
            while free < expected:
                x0, y0, x1, y1 = cells
                at = cells[side] + min(way, 0)  # the cells beyond this side
                if not 0 <= at < grid.shape[1 - axis]:
                    break
                beyond = grid[y0:y1, at] if axis == 0 else grid[at, x0:x1]
                if (beyond != own).any():
                    break
                cells[side] += way
                free += 1
            grown[side] += way * min(expected, free)
    return grown


@settings(max_examples=200)
@given(
    arrays(np.uint8, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.integers(0, 1)),
    st.sampled_from([0.0, 0.4, 1.0]),
)
def test_growth_stays_within_the_own_colour(grid, growth):
    boxes = partition(grid)
    grown = grow(grid, boxes, growth)
    for box, (u0, v0, u1, v1) in zip(boxes.tolist(), grown, strict=True):
        touched = grid[int(np.floor(v0)) : int(np.ceil(v1)), int(np.floor(u0)) : int(np.ceil(u1))]
        assert u0 >= 0
        assert v0 >= 0
        assert u1 <= grid.shape[1]
        assert v1 <= grid.shape[0]
        assert (touched == grid[box[1], box[0]]).all()
        assert np.allclose([u0, v0, u1, v1], grown_by_definition(grid, box, growth))


def test_growth_is_measured_in_modules():
    grid = np.array([[1, 1, 1], [0, 1, 0]], np.uint8)
    boxes = np.array([[0, 0, 3, 1], [1, 1, 2, 2], [0, 1, 1, 2], [2, 1, 3, 2]])
    grown = grow(grid, boxes, 0.25)
    assert grown.tolist() == [[0, 0, 3, 1], [1, 0.75, 2, 2], [0, 1, 1, 2], [2, 1, 3, 2]]
    assert 0 < fitted_growth() <= 1


def test_long_rectangles_grow_along_their_axis_in_proportion():
    """As the sides of a quiet zone do, beneath its top and its bottom."""
    grid = np.zeros((24, 30), np.uint8)
    grid[4:20, 4:26] = 1
    side = np.array([[0, 4, 4, 20]])
    for growth in (0.1, 0.2):
        assert np.allclose(
            grow(grid, side, growth), [[0, 4 - 16 * LONG * growth, 4, 20 + 16 * LONG * growth]]
        )
    assert grow(grid, side, 1.0).tolist() == [[0, 0, 4, 24]]
