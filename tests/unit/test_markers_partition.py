"""The minimum rectilinear partition: exact, and minimal against the formula and against exhaustive search."""

import random
import string
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from euler_number import count_holes
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from fidsplat.images.tag_dictionaries import dictionary_bits
from fidsplat.markers import marker
from fidsplat.markers.partition import (
    chords,
    concave_vertices,
    independent_chords,
    merge_runs,
    minimum_rectangles,
    partition,
)
from fidsplat.markers.regions import label_components

SMALL = arrays(np.uint8, st.tuples(st.integers(1, 8), st.integers(1, 8)), elements=st.integers(0, 1))
CHECKERBOARD = np.indices((6, 6)).sum(0).astype(np.uint8) % 2
PLUS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
FRAME = np.pad(np.zeros((2, 3), np.uint8), 1, constant_values=1)
# two holes that touch at a corner: one 8-connected hole
TOUCHING = np.array([[1, 1, 1, 1], [1, 0, 1, 1], [1, 1, 0, 1], [1, 1, 1, 1]], np.uint8)
# chords that share an end, and one that crosses both
SHARED = np.array([[0, 1, 0, 1], [1, 1, 1, 1], [0, 1, 0, 1], [1, 1, 1, 1]], np.uint8)


def check_exact(grid: np.ndarray, boxes: np.ndarray) -> None:
    cover = np.zeros(grid.shape, int)
    for x0, y0, x1, y1 in boxes.tolist():
        assert 0 <= x0 < x1 <= grid.shape[1]
        assert 0 <= y0 < y1 <= grid.shape[0]
        cover[y0:y1, x0:x1] += 1
        assert (grid[y0:y1, x0:x1] == grid[y0, x0]).all()
    assert (cover == 1).all()
    assert boxes.tolist() == sorted(boxes.tolist(), key=lambda box: (box[1], box[0]))


def naive_counts(cells: frozenset) -> tuple[int, int]:
    """Concave vertices of a component, and the size of its largest set of chords that do not meet.

    From the definitions: a vertex with exactly three cells; every pair on a line, neighbours or not, whose
    whole open segment is interior; Kuhn's matching over all pairs that meet.
    """

    def four(y, x):
        return [(y - 1, x - 1) in cells, (y - 1, x) in cells, (y, x - 1) in cells, (y, x) in cells]

    corners = {(y + dy, x + dx) for y, x in cells for dy in (0, 1) for dx in (0, 1)}
    concave = sorted(v for v in corners if sum(four(*v)) == 3)
    lines: dict = {}
    for y, x in concave:
        lines.setdefault(("h", y), []).append(x)
        lines.setdefault(("v", x), []).append(y)
    across, down = [], []
    for (axis, line), at in sorted(lines.items()):
        for a, b in combinations(sorted(at), 2):
            vertex = (lambda t, c=line: (c, t)) if axis == "h" else (lambda t, c=line: (t, c))
            if (
                all(sum(four(*vertex(t))) == 4 for t in range(a + 1, b))
                and ({(line - 1, a), (line, a)} if axis == "h" else {(a, line - 1), (a, line)}) <= cells
            ):
                (across if axis == "h" else down).append((line, a, b))
    meet = [[j for j, (x, c, d) in enumerate(down) if a <= x <= b and c <= y <= d] for y, a, b in across]
    partner: dict[int, int] = {}

    def augment(i, seen):
        for j in meet[i]:
            if j not in seen:
                seen.add(j)
                if j not in partner or augment(partner[j], seen):
                    partner[j] = i
                    return True
        return False

    matched = sum(augment(i, set()) for i in range(len(across)))
    return len(concave), len(across) + len(down) - matched


def check_formula(grid: np.ndarray, boxes: np.ndarray) -> None:
    """Per component: rectangles = concave vertices - independent chords - holes + 1, counted from scratch."""
    labels, count = label_components(grid)
    actual = np.bincount(labels[boxes[:, 1], boxes[:, 0]], minlength=count)
    holes = count_holes(labels, count)
    order = np.argsort(labels.ravel(), kind="stable")
    parts = np.split(order, np.searchsorted(labels.ravel()[order], np.arange(1, count)))
    for i, part in enumerate(parts):
        cells = frozenset(divmod(int(cell), grid.shape[1]) for cell in part)
        concave, independent = naive_counts(cells)
        assert actual[i] == concave - independent - holes[i] + 1


def fewest_rectangles(cells: frozenset) -> int:
    """Exhaustive: whichever rectangle has the first cell as its corner, then the rest."""

    @cache
    def fewest(left: frozenset) -> int:
        if not left:
            return 0
        y, x = min(left)
        best, widest = len(left), 99
        for height in range(1, 99):
            row = 0
            while row < widest and (y + height - 1, x + row) in left:
                row += 1
            widest = min(widest, row)
            if not widest:
                break
            for width in range(1, widest + 1):
                box = {(y + i, x + j) for i in range(height) for j in range(width)}
                best = min(best, 1 + fewest(left - box))
        return best

    return fewest(cells)


@settings(max_examples=250)
@given(SMALL)
@example(CHECKERBOARD)
@example(PLUS)
@example(FRAME)
@example(TOUCHING)
@example(1 - TOUCHING)
@example(SHARED)
def test_small_grids_are_exact_and_match_the_formula(grid):
    boxes = partition(grid)
    check_exact(grid, boxes)
    check_formula(grid, boxes)


@settings(max_examples=150)
@given(arrays(np.uint8, st.tuples(st.integers(2, 5), st.integers(2, 5)), elements=st.integers(0, 1)))
@example(PLUS)
@example(TOUCHING)
@example(SHARED)
def test_no_partition_has_fewer_rectangles(grid):
    labels, count = label_components(grid)
    actual = np.bincount(labels[tuple(partition(grid)[:, [1, 0]].T)], minlength=count)
    for i in range(count):
        cells = frozenset((int(y), int(x)) for y, x in np.argwhere(labels == i))
        assert actual[i] == fewest_rectangles(cells)


@settings(max_examples=200)
@given(SMALL)
@example(CHECKERBOARD)
@example(TOUCHING)
def test_the_estimate_is_a_lower_bound(grid):
    labels, _ = label_components(grid)
    padded = np.pad(labels, 1, constant_values=-1)
    corners = 0  # of every component, by its cells around each vertex
    for y, x in np.ndindex(grid.shape[0] + 1, grid.shape[1] + 1):
        around = padded[y : y + 2, x : x + 2]
        for label in set(around.ravel().tolist()) - {-1}:
            cells = around == label
            corners += {1: 1, 3: 1, 2: 2 * (cells[0, 0] == cells[1, 1])}.get(int(cells.sum()), 0)
    assert 4 * minimum_rectangles(grid) <= corners
    assert minimum_rectangles(grid) <= len(partition(grid))


def test_the_estimate_is_near():
    assert minimum_rectangles(CHECKERBOARD) == 36
    noise = (np.random.default_rng(0).random((150, 150)) < 0.5).astype(np.uint8)
    assert minimum_rectangles(noise) > 0.85 * len(partition(noise))


def test_every_tag_of_36h11():
    for i in range(587):
        grid = np.pad(dictionary_bits("apriltag", "36h11", i), 1)
        boxes = partition(grid)
        check_exact(grid, boxes)
        check_formula(grid, boxes)


@pytest.mark.parametrize(("length", "version"), [(20, 2), (100, 5), (250, 10), (1000, 22)])
def test_qr_codes(length, version):
    text = "".join(random.Random(length).choices(string.ascii_letters + string.digits, k=length))
    sign = marker(f"qr:{text}")
    assert sign.family == f"v{version}-L"
    check_exact(sign.grid, sign.boxes)
    check_formula(sign.grid, sign.boxes)


def test_shapes_known_by_hand():
    def count(grid):
        return len(partition(np.asarray(grid, np.uint8)))

    assert count([[1]]) == 1
    assert count(np.zeros((3, 4))) == 1
    assert count(CHECKERBOARD) == 36
    assert count(PLUS) == 3 + 4
    assert count(FRAME) == 4 + 1
    assert count(TOUCHING) == 6 + 2


def test_checkerboard_vertices_are_not_concave():
    assert not concave_vertices(CHECKERBOARD).any()
    # the ring around two diagonal holes: six concave vertices, none where the holes touch
    concave = concave_vertices(TOUCHING)
    assert concave.sum() == 6
    assert not concave[2, 2]


def test_chords_are_between_neighbours_with_an_interior_between():
    # a comb with teeth up and down: on each line concave vertices see each other, or a gap lies between
    grid = np.array([[0, 1, 0, 1, 0], [1, 1, 1, 1, 1], [0, 1, 0, 1, 0]], np.uint8)
    concave = concave_vertices(grid)
    actual = {tuple(chord) for chord in chords(grid, concave).tolist()}
    assert actual == {(1, 1, 2), (1, 3, 4), (2, 1, 2), (2, 3, 4)}
    across, down = independent_chords(grid, concave)
    assert len(across) + len(down) == 4


def test_large_grids_take_no_quadratic_time():
    # half a million cells with about as many concave vertices; all pairs would take days
    grid = (np.random.default_rng(0).random((700, 700)) < 0.5).astype(np.uint8)
    check = partition(grid)
    area = (check[:, 2] - check[:, 0]) * (check[:, 3] - check[:, 1])
    assert area.sum() == grid.size


def test_the_same_on_every_run():
    grid = (np.random.default_rng(3).random((60, 60)) < 0.5).astype(np.uint8)
    assert np.array_equal(partition(grid), partition(grid.copy()))


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (6, 1), (9, 12)])
def test_merged_runs_cover_each_cell_once_in_its_colour(shape):
    grid = np.random.default_rng(5).integers(0, 3, shape).astype(np.uint8)
    painted = np.full(shape, -1)
    for x0, y0, x1, y1 in merge_runs(grid):
        assert (painted[y0:y1, x0:x1] == -1).all()
        painted[y0:y1, x0:x1] = grid[y0, x0]
    assert np.array_equal(painted, grid)
    striped = np.repeat(np.arange(4, dtype=np.uint8)[None], 5, 0)
    assert len(merge_runs(striped)) == len(merge_runs(striped.T)) == 4
