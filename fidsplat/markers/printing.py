"""Conversion of rectangles to splats on the marker's plane: boxes, or Gaussians of a mixture."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fidsplat.markers.mixture import Template, count_gaussians, place
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError
from fidsplat.util.progress import Progress

if TYPE_CHECKING:
    from shapely import MultiPolygon

MAX_SPLATS = 1_000_000
"""Default maximum number of splats of a marker."""

SLIVER = 1 / 64
"""Modules: thinner rectangles of a drawing become no Gaussians."""

CHUNK = 1 << 18
"""Splats of a part: bounds the memory of float64 temporaries."""


class Printed(NamedTuple):
    """Rectangles of a marker with their colours and positions in metres."""

    grid: np.ndarray
    """(H, W) uint8, values of modules"""
    boxes: np.ndarray
    """(n, 4) x0, y0, x1, y1 in modules"""
    values: np.ndarray
    """(n,) uint8, value of each rectangle"""
    angles: np.ndarray | None
    """(n,) radians, rotation of each about its centre; None: no rotation"""
    regions: tuple[MultiPolygon, ...] | None
    """region of each value for drawings with slanted or curved edges; else None"""
    module: float
    """size of a module in metres"""
    palette: np.ndarray
    """(k, 3) float32 RGB, colours of the values"""


def refuse_more(spec: str, count: int, max_splats: int, words: str = "") -> None:
    """Raise InputError if a marker has more splats than `max_splats`."""
    if count > max_splats:
        raise InputError(
            f"{spec} must have at most {max_splats:,} splats, got {words}{count:,}; use a smaller image or a "
            "mixture with fewer Gaussians per rectangle, or increase max_splats (--max-splats N)"
        )


def box_cloud(printed: Printed, progress: Progress) -> SplatCloud:
    """Cloud of one box for each rectangle."""
    boxes = printed.boxes

    def make(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        corners = boxes[start:stop].astype(np.float64)
        middle, half = (corners[:, :2] + corners[:, 2:]) / 2, (corners[:, 2:] - corners[:, :2]) / 2
        return np.column_stack([middle, half, np.ones(stop - start)]), np.arange(start, stop)

    return _cloud(printed, np.arange(1, len(boxes) + 1), make, progress).with_boxes()


def without_slivers(printed: Printed) -> Printed:
    """Remove slivers between touching curves of a drawing; each would need thousands of Gaussians."""
    if printed.angles is None:
        return printed
    sides = printed.boxes[:, 2:] - printed.boxes[:, :2]
    thick = sides.min(1) >= SLIVER
    if not thick.any():
        return printed
    return printed._replace(
        boxes=printed.boxes[thick], values=printed.values[thick], angles=printed.angles[thick]
    )


def aspect_of(boxes: np.ndarray) -> np.ndarray:
    """Aspect ratios, width over height, of (n, 4) rectangles."""
    return (boxes[:, 2] - boxes[:, 0]) / (boxes[:, 3] - boxes[:, 1])


def gaussian_cloud(
    printed: Printed, templates: tuple[Template, ...], growth: float, progress: Progress
) -> SplatCloud:
    """Cloud of Gaussians that approximate the printed rectangles."""
    aspect = aspect_of(printed.boxes)
    grown = _grown(printed, growth)
    ends = np.cumsum(count_gaussians(aspect, templates))

    def make(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        gaussians, owner = place(grown[start:stop], aspect[start:stop], templates)
        return gaussians, owner + start

    return _cloud(printed, ends, make, progress)


def _grown(printed: Printed, growth: float) -> np.ndarray:
    """Rectangles extended by `growth`, for each colour of a drawing."""
    grid, boxes, values = printed.grid, printed.boxes, printed.values
    if printed.regions is not None and printed.angles is not None:
        from fidsplat.markers.cover import grow_rotated  # here, since it imports shapely

        return grow_rotated(printed.regions, values, boxes, printed.angles, growth)
    if len(printed.palette) <= 2:
        return grow(grid, boxes, growth)
    grown = boxes.astype(np.float64)
    for value in np.unique(values):
        mask = values == value
        grown[mask] = grow((grid == value).astype(np.uint8), boxes[mask], growth)
    return grown


def _cloud(
    printed: Printed,
    ends: np.ndarray,
    make: Callable[[int, int], tuple[np.ndarray, np.ndarray]],
    progress: Progress,
) -> SplatCloud:
    """Splats in the colours of their rectangles.

    ends: (n,) cumulative number of splats by rectangle. make: returns the splats of a range of rectangles:
    rows (m, 5) of position and scale in modules and opacity, and (m,) the rectangle of each. Two threads fill
    the cloud chunk by chunk, so that the peak of memory is near the size of the cloud.
    """
    module, angles = printed.module, printed.angles
    total = int(ends[-1])
    means, scales = np.zeros((total, 3), np.float32), np.empty((total, 2), np.float32)
    opacities, colors = np.empty(total, np.float32), np.empty((total, 3), np.float32)
    quats = np.zeros((total, 4), np.float32)
    quats[:, 0] = 1
    middle = np.array(printed.grid.shape[::-1]) / 2

    def fill(part: tuple[int, int]) -> int:
        rows, owner = make(*part)
        done = int(ends[part[1] - 1])
        at = slice(done - len(rows), done)
        if angles is not None:
            place, angle = (printed.boxes[owner, :2] + printed.boxes[owner, 2:]) / 2, angles[owner]
            (x, y), c, s = (rows[:, :2] - place).T, np.cos(angle), np.sin(angle)
            rows[:, :2] = place + np.column_stack([c * x - s * y, s * x + c * y])
            quats[at, 0], quats[at, 3] = np.cos(angle / 2), np.sin(angle / 2)
        for axis in (0, 1):
            means[at, axis] = (rows[:, axis] - middle[axis]) * module
            scales[at, axis] = rows[:, 2 + axis] * module
        opacities[at] = rows[:, 4]
        np.take(printed.palette, printed.values[owner], axis=0, out=colors[at], mode="clip")
        return done

    progress("splats", 0.0)
    with ThreadPoolExecutor(2) as pool:
        for done in pool.map(fill, _parts(ends)):
            if done < total:
                progress("splats", done / total)
    arrays = (means, quats, scales, opacities, colors)
    for array in arrays:
        array.flags.writeable = False  # without a copy by SplatCloud
    # one sheet of paper: the order of its splats does not matter
    cloud = SplatCloud.from_validated(
        means, quats, scales, opacities, colors=colors, origin=np.zeros(3), dropped={}
    )
    return cloud.with_coplanar_groups(0)


def _parts(ends: np.ndarray) -> Iterator[tuple[int, int]]:
    """Ranges of rectangles of about `CHUNK` splats."""
    start = 0
    while start < len(ends):
        before = int(ends[start - 1]) if start else 0
        stop = max(int(np.searchsorted(ends, before + CHUNK, "right")), start + 1)
        yield start, stop
        start = stop


LONG = 0.6
"""A rectangle with a length of L modules along an axis grows by max(1, LONG * L) times the growth there."""


def grow(grid: np.ndarray, rectangles: np.ndarray, growth: float) -> np.ndarray:
    """Extend rectangles of an (h, w) 0/1 grid across the sides that border only their own colour.

    rectangles: (n, 4) ints x0, y0, x1, y1 in cells. growth: growth of short rectangles in modules, 0 to 1;
    `LONG` is that of longer ones. Returns (n, 4) float64.

    A mixture fades towards its edges, which leaves a seam between rectangles of a component unless they
    overlap. Templates are scaled, so long rectangles fade over a longer distance and need a larger overlap.
    All cells that a rectangle grows into, corners included, have its colour. The longer axis is extended
    first.
    """
    h, w = grid.shape
    padded = np.full((h + 2, w + 2), 2, np.int8)  # 2: outside of the grid
    padded[1:-1, 1:-1] = grid
    color = grid[rectangles[:, 1], rectangles[:, 0]]
    # sums[c, y, x]: cells of colour c above and left of the vertex of the padded grid
    sums = np.zeros((2, h + 3, w + 3), np.int64)
    for c in (0, 1):
        np.cumsum(np.cumsum(padded == c, 0), 1, out=sums[c, 1:, 1:])

    size = rectangles[:, 2:] - rectangles[:, :2]
    target = growth * np.maximum(1.0, LONG * size)
    cells = rectangles + 1  # cells that a rectangle intersects, in the padded grid
    grown = rectangles.astype(np.float64)
    first = (size[:, 1] > size[:, 0]).astype(np.int64)
    every = np.arange(len(size))
    for axis in (first, 1 - first):
        for end, way in ((0, -1), (2, 1)):
            left = target[every, axis]
            # a test of one cell of the next strip excludes most rectangles
            corner = cells[:, :2].copy()
            corner[every, axis] = cells[every, axis + end] - (end == 0)
            moving = np.flatnonzero((left > 0) & (padded[corner[:, 1], corner[:, 0]] == color))
            while len(moving):
                side = axis[moving] + end
                rows = np.arange(len(moving))
                strip = cells[moving]
                strip[rows, axis[moving] + 2 - end] = strip[rows, side]
                strip[rows, side] += way
                x0, y0, x1, y1 = strip.T
                c = color[moving]
                area = sums[c, y1, x1] - sums[c, y0, x1] - sums[c, y1, x0] + sums[c, y0, x0]
                free = area == (x1 - x0) * (y1 - y0)
                moving, side = moving[free], side[free]
                cells[moving, side] += way
                grown[moving, side] += way * np.minimum(left[moving], 1.0)
                left[moving] -= 1.0
                moving = moving[left[moving] > 0]
    return grown
