"""Components, holes and polygons of grids."""

import numpy as np
import pytest
import shapely
from euler_number import count_holes

from fidsplat.markers.regions import label_components, polygons

FOUR = ((0, 1), (1, 0), (0, -1), (-1, 0))
EIGHT = (*FOUR, (1, 1), (1, -1), (-1, 1), (-1, -1))


def flood(mask: np.ndarray, steps) -> list[set[tuple[int, int]]]:
    """Components of the True cells, in raster order."""
    left, results = set(zip(*np.nonzero(mask), strict=True)), []
    for cell in sorted(left):
        if cell not in left:
            continue
        stack, part = [cell], {cell}
        left.discard(cell)
        while stack:
            y, x = stack.pop()
            for dy, dx in steps:
                other = (y + dy, x + dx)
                if other in left:
                    left.discard(other)
                    part.add(other)
                    stack.append(other)
        results.append(part)
    return results


def holes(cells: set[tuple[int, int]], shape: tuple[int, int]) -> int:
    outside = np.ones((shape[0] + 2, shape[1] + 2), bool)
    for y, x in cells:
        outside[y + 1, x + 1] = False
    return len(flood(outside, EIGHT)) - 1


def grids():
    rng = np.random.default_rng(0)
    for _ in range(80):
        h, w = rng.integers(1, 12, 2)
        yield (rng.random((h, w)) < rng.uniform(0.2, 0.8)).astype(np.uint8)
    yield np.indices((9, 9)).sum(0).astype(np.uint8) % 2
    yield np.zeros((4, 7), np.uint8)
    yield np.ones((1, 1), np.uint8)


@pytest.mark.parametrize("grid", list(grids()), ids=lambda grid: f"{grid.shape}")
def test_components_holes_and_polygons(grid):
    labels, count = label_components(grid)
    parts = sorted(flood(grid == 0, FOUR) + flood(grid == 1, FOUR), key=min)
    assert count == len(parts)
    number = count_holes(labels, count)
    shapes = polygons(grid, labels, count)
    assert len(shapes) == count
    for i, part in enumerate(parts):  # raster order of the first cell
        assert {tuple(cell) for cell in np.argwhere(labels == i)} == part
        assert number[i] == holes(part, grid.shape)
        assert shapes[i].is_valid
        assert shapes[i].area == len(part)
        centers = shapely.points([(x + 0.5, y + 0.5) for y, x in sorted(part)])
        assert shapely.contains(shapes[i], centers).all()


def test_a_long_spiral_is_one_component():
    n = 101
    grid = np.zeros((n, n), np.uint8)
    y = x = 0
    dy, dx = 0, 1
    grid[0, 0] = 1
    for _ in range(n * n):
        ny, nx = y + 2 * dy, x + 2 * dx
        if not (0 <= ny < n and 0 <= nx < n) or grid[ny, nx]:
            dy, dx = dx, -dy
            ny, nx = y + 2 * dy, x + 2 * dx
            if not (0 <= ny < n and 0 <= nx < n) or grid[ny, nx]:
                break
        grid[y + dy, x + dx] = 1
        y, x = y + dy, x + dx
        grid[y + dy, x + dx] = 1
        y, x = y + dy, x + dx
    labels, _ = label_components(grid)
    assert len(np.unique(labels[grid == 1])) == 1
