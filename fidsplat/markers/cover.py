"""Cover of regions with slanted or curved edges by rectangles: rotated bands along the edges, and modules
inside.

Bands of two colours share an edge, which is therefore as sharp as that of a box. The width of a band is the
distance to the medial axis, at most `BAND`. Rectangles of one colour overlap.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import shapely

from fidsplat.markers.partition import partition
from fidsplat.util import interrupts

BAND = 2.5
"""Maximum width of a band in modules. Whole modules outside of the bands are a module or more from any
edge."""

SHORTEST = 1 / 64
"""Minimum length of a piece of an edge, in modules."""

SHARP = np.radians(10)
"""Corners with a smaller angle get no extra rectangles."""

SLACK = 1e-6
"""Tolerance in modules by which a rectangle may exceed its region."""


class _Sides(NamedTuple):
    """Pieces of the edges, and the rotation angle to the next edge at concave corners."""

    start: np.ndarray
    """(n, 2) modules"""
    stop: np.ndarray
    """(n, 2) modules; equal to `start` at a corner"""
    inward: np.ndarray
    """(n,) radians, direction of the normal into the region, which is to the left from start to stop"""
    turn: np.ndarray
    """(n,) radians, clockwise rotation of the normal at `stop`, up to 90 degrees"""


def cover_all(
    regions: tuple[shapely.MultiPolygon, ...], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cover of several regions: rectangles (n, 4), their angles (n,), and the region of each, (n,) uint8."""
    covers = {value: cover(region, shape) for value, region in enumerate(regions) if not region.is_empty}
    boxes, angles = (np.concatenate(parts) for parts in zip(*covers.values(), strict=True))
    values = np.repeat(np.array(list(covers), np.uint8), [len(pieces) for _, pieces in covers.values()])
    return boxes, angles, values


def cover(region: shapely.MultiPolygon, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Rectangles whose union is a region of a grid of (h, w) modules.

    Returns (n, 4) float64 x0, y0, x1, y1 in modules before the rotation about the centre, and (n,) angles in
    radians, from x to y.
    """
    corners = np.concatenate([_bands(region), _modules(region, shape)])
    # tips of corners, which would be subdivided without end
    left = shapely.get_parts(region - shapely.union_all(shapely.polygons(corners)))
    left = shapely.oriented_envelope(left[shapely.area(left) > SHORTEST**3])
    rest = [shapely.get_coordinates(part)[:4] for part in left if isinstance(part, shapely.Polygon)]
    corners = np.concatenate([corners, np.reshape(rest, (-1, 4, 2))])
    along, across = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    half = np.column_stack([np.hypot(*along.T), np.hypot(*across.T)]) / 2
    middle = corners.mean(1)
    return np.hstack([middle - half, middle + half]), np.arctan2(along[:, 1], along[:, 0])


def _modules(region: shapely.MultiPolygon, shape: tuple[int, int]) -> np.ndarray:
    """Rectangles of modules over the interior without the bands, as corners (n, 4, 2)."""
    interior = _intersecting(shapely.buffer(region, -BAND), shape)
    boxes = partition(interior)
    x0, y0, x1, y1 = boxes[interior[boxes[:, 1], boxes[:, 0]] == 1].T.astype(np.float64)
    return np.stack([x0, y0, x1, y0, x1, y1, x0, y1], 1).reshape(-1, 4, 2)


def _intersecting(region: shapely.Geometry, shape: tuple[int, int]) -> np.ndarray:
    """Modules (h, w) that intersect a region, 0 or 1, by quadtree subdivision."""
    shapely.prepare(region)
    grid, side = np.zeros(shape, np.uint8), 1 << max(shape).bit_length()
    x = y = np.zeros(1, int)
    while len(x):
        squares = shapely.box(x, y, x + side, y + side)
        met = shapely.intersects(region, squares)
        done = met & (shapely.covers(region, squares) if side > 1 else True)
        for x0, y0 in zip(x[done], y[done], strict=True):
            grid[y0 : y0 + side, x0 : x0 + side] = 1
        side //= 2
        rest = met & ~done
        x = np.concatenate([x[rest], x[rest] + side] * 2)
        y = np.concatenate([y[rest], y[rest], y[rest] + side, y[rest] + side])
    return grid


def _bands(region: shapely.MultiPolygon) -> np.ndarray:
    """Rectangles over the bands along the edges, as corners (n, 4, 2)."""
    edges, sides = _sides(region)
    tree = shapely.STRtree(list(shapely.get_parts(shapely.linestrings(edges))))
    within = shapely.buffer(region, SLACK, join_style="mitre")
    shapely.prepare(within)
    bands = []
    while len(sides.start):
        rectangles = _rectangles(sides, _widths(sides, edges, tree))
        long = np.linalg.norm(sides.stop - sides.start, axis=1) > SHORTEST
        done = shapely.covers(within, shapely.polygons(rectangles))
        bands.append(rectangles[done])
        rest = ~done & (long | (sides.turn > SHARP))
        sides = _halves(_Sides(*(values[rest] for values in sides)), long[rest])
    return np.concatenate(bands)


def _sides(region: shapely.MultiPolygon) -> tuple[np.ndarray, _Sides]:
    """Edges (n, 2, 2) of a region, and the pieces along which rotated rectangles are placed."""
    starts, stops, inward, angles = [], [], [], []
    for polygon in region.geoms:
        rings = [polygon.exterior, *polygon.interiors]
        for number, ring in enumerate(rings):
            points = shapely.get_coordinates(ring)[:-1]
            if shapely.is_ccw(ring) != (number == 0):
                points = points[::-1]
            step = np.roll(points, -1, 0) - points
            angle = np.arctan2(step[:, 1], step[:, 0])
            starts.append(points)
            stops.append(np.roll(points, -1, 0))
            inward.append(angle + np.pi / 2)
            angles.append((angle - np.roll(angle, -1) + np.pi) % (2 * np.pi) - np.pi)
    start, stop, normal, turn = (np.concatenate(parts) for parts in (starts, stops, inward, angles))
    turn = np.maximum(turn, 0)
    gentle = turn <= SHARP
    sides = [_Sides(start, stop, normal, np.where(gentle, turn, 0))]
    for part in (0, np.pi / 2):
        sharp = ~gentle & (turn > part)
        rest = np.minimum(turn[sharp] - part, np.pi / 2)
        sides.append(_Sides(stop[sharp], stop[sharp], normal[sharp] - part, rest))
    return np.stack([start, stop], 1), _Sides(*(np.concatenate(parts) for parts in zip(*sides, strict=True)))


def _widths(sides: _Sides, edges: np.ndarray, tree: shapely.STRtree) -> np.ndarray:
    """Widths (n,) of the bands: the distance to the medial axis, at most BAND, maximum over samples.

    At each sample an inscribed circle that touches the side shrinks until it has no other edges inside.
    """
    fraction = (
        1 - np.cos(np.pi * (np.arange(9) + 0.5) / 9)
    ) / 2  # more samples near corners, where the width varies
    fraction = np.append(fraction, (1, 1))
    bend = np.append(np.zeros(9), (0.5, 1))
    at = sides.start[:, None] + fraction[:, None] * (sides.stop - sides.start)[:, None]
    angle = sides.inward[:, None] - bend * sides.turn[:, None]
    normal = np.stack([np.cos(angle), np.sin(angle)], -1).reshape(-1, 2)
    at, radius = at.reshape(-1, 2), np.full(angle.size, BAND)
    left = np.arange(angle.size)
    while len(left):
        interrupts.check()
        middle = at[left] + radius[left, None] * normal[left]
        nearest = tree.query_nearest(shapely.points(middle), all_matches=False)[1]
        a, step = edges[nearest, 0], edges[nearest, 1] - edges[nearest, 0]
        along = np.clip(((middle - a) * step).sum(1) / (step * step).sum(1), 0, 1)
        gap = a + along[:, None] * step - at[left]
        inside = np.linalg.norm(gap + at[left] - middle, axis=1) < radius[left] - 1e-4
        left, gap = left[inside], gap[inside]
        before, radius[left] = radius[left], (gap * gap).sum(1) / (2 * (gap * normal[left]).sum(1))
        left = left[radius[left] < 0.99 * before]
    return 1.02 * radius.reshape(angle.shape).max(1)


def _rectangles(sides: _Sides, width: np.ndarray) -> np.ndarray:
    """Corners (n, 4, 2) of a rectangle inwards from each side, of its width, prolonged over the sector at the
    side's concave corner."""
    inward = width[:, None] * np.column_stack([np.cos(sides.inward), np.sin(sides.inward)])
    ahead = np.sin(sides.turn)[:, None] * np.column_stack([inward[:, 1], -inward[:, 0]])
    stop = sides.stop + ahead
    return np.stack([sides.start, stop, stop + inward, sides.start + inward], 1)


def _halves(sides: _Sides, long: np.ndarray) -> _Sides:
    """Split long edges in halves; short ones are reduced to their corner."""
    start, stop, inward, turn = sides
    middle = np.where(long[:, None], (start + stop) / 2, stop)
    bend = np.where(long, 0, turn / 2)
    first = _Sides(start, middle, inward, bend)
    second = _Sides(middle, stop, inward - bend, turn - bend)
    return _Sides(*(np.concatenate(pair) for pair in zip(first, second, strict=True)))


def grow_rotated(
    regions: tuple[shapely.MultiPolygon, ...],
    values: np.ndarray,
    boxes: np.ndarray,
    angles: np.ndarray,
    growth: float,
) -> np.ndarray:
    """Extend rectangles of `cover_all` across sides if the extension stays in their region, by `growth`
    modules or the same fraction of their width."""
    grown = boxes.copy()
    for value, region in enumerate(regions):
        shapely.prepare(region)
        rows = np.flatnonzero(values == value)
        extension = growth * np.minimum(1, (boxes[rows, 2:] - boxes[rows, :2]).min(1))
        for side in range(4):
            tried = grown[rows]
            tried[:, side] += np.where(side < 2, -extension, extension)
            free = shapely.covers(region, shapely.polygons(rotated(tried, boxes[rows], angles[rows])))
            grown[rows[free]] = tried[free]
    return grown


def rotated(boxes: np.ndarray, about: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Corners (n, 4, 2) of boxes, each rotated about the centre of another box."""
    middle = (about[:, None, :2] + about[:, None, 2:]) / 2
    x, y = np.moveaxis(boxes[:, [[0, 1], [2, 1], [2, 3], [0, 3]]] - middle, -1, 0)
    c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
    return middle + np.stack([c * x - s * y, s * x + c * y], -1)
