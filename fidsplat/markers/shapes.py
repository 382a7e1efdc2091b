"""Visible regions of overlapping painted shapes: polygons with holes, one region for each colour."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from fidsplat.markers.paths import Rings
from fidsplat.util.errors import InputError

FLAT = 0.005
"""Tolerance of polylines for curves, in modules."""

GRID = 1e-6
"""Grid in modules to which intersections of shapes are rounded."""


MAX_OVERLAPS = 50_000
"""Maximum number of pairs of shapes whose bounds overlap."""


MAX_CROSSINGS = 5_000
"""Maximum number of crossings of outlines."""


MAX_NEIGHBORS = 5_000_000
"""Maximum number of pairs of straight pieces of outlines whose bounds overlap."""


def refuse_tangles(rings: Rings, name: str | None) -> None:
    """Raise InputError for outlines with too many crossings to make polygons of them."""
    pieces = np.concatenate(
        [np.zeros((0, 2, 2)), *(np.stack([ring, np.roll(ring, -1, 0)], 1) for ring in rings)]
    )
    lines = np.array(shapely.linestrings(pieces))
    tree, neighbors, crossings = shapely.STRtree(list(lines)), 0, 0
    for start in range(0, len(lines), 256):  # few at a time, since each may cross all others
        one, other = tree.query(lines[start : start + 256])
        one, other = np.array([one + start, other])[:, other > one + start]
        neighbors += len(one)
        if neighbors <= MAX_NEIGHBORS:
            crossings += int(_crosses(pieces[one], pieces[other]).sum())
        if crossings > MAX_CROSSINGS:
            raise InputError(
                f"outlines of {name} must cross in at most {MAX_CROSSINGS} places, got more; simplify the "
                "drawing"
            )
        if neighbors > MAX_NEIGHBORS:
            raise InputError(
                f"{name} must have outlines with at most {MAX_NEIGHBORS:,} pairs of pieces near each other, "
                "got more; simplify the drawing"
            )


def _crosses(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Whether the interiors of segments (n, 2 ends, 2) intersect, (n,) bool."""

    def sides(segments: np.ndarray, ends: np.ndarray) -> np.ndarray:
        along, to = segments[:, 1] - segments[:, 0], ends - segments[:, :1]
        return along[:, None, 0] * to[..., 1] - along[:, None, 1] * to[..., 0]

    return (np.sign(sides(one, other)).prod(axis=1) < 0) & (np.sign(sides(other, one)).prod(axis=1) < 0)


def filled(rings: Rings, rule: str) -> shapely.MultiPolygon:
    """Filled region of closed rings of points (n, 2).

    rule: "nonzero" (the winding number) or "evenodd" (the number of crossings).
    """
    lines = [shapely.LinearRing(ring).simplify(FLAT) for ring in rings if len(ring) > 2]
    faces = shapely.get_parts(shapely.polygonize(shapely.get_parts(shapely.union_all(lines, grid_size=GRID))))
    winding = np.zeros(len(faces), np.int64)
    x, y = shapely.get_coordinates(shapely.point_on_surface(faces)).T[..., None]
    for line in lines:
        ring = shapely.get_coordinates(line)
        (ax, ay), (bx, by) = ring[:-1].T, ring[1:].T
        down, up = (ay <= y) & (y < by), (by <= y) & (y < ay)
        with np.errstate(all="ignore"):
            right = x < ax + (y - ay) / (by - ay) * (bx - ax)
        winding += (down & right).sum(1) - (up & right).sum(1)
    return _polygons(shapely.union_all(faces[winding % 2 == 1 if rule == "evenodd" else winding != 0]))


def visible(
    shapes: Sequence[tuple[shapely.Geometry, int]], shape: tuple[int, int]
) -> tuple[shapely.MultiPolygon, ...]:
    """Visible region of each value, for shapes painted in order on a sheet of (h, w) modules with the value
    0.

    Raises InputError if too many shapes overlap."""
    geometries = np.array([painted for painted, _ in shapes], object)
    tree, sheet = shapely.STRtree(geometries), shapely.box(0, 0, shape[1], shape[0])
    if tree.query(geometries).shape[1] > 2 * MAX_OVERLAPS:
        raise InputError(
            f"a drawing must have at most {MAX_OVERLAPS} pairs of overlapping shapes, got more; simplify it"
        )
    parts: list[list[shapely.Geometry]] = [[] for _ in range(1 + max((v for _, v in shapes), default=0))]
    for number, (painted, value) in enumerate(shapes):
        above = tree.query(painted)
        over = shapely.union_all(geometries[above[above > number]], grid_size=GRID)
        # a shape that only touches the sheet or another shape leaves lines, which further cuts reject
        parts[value].append(_polygons(shapely.difference(painted, over, grid_size=GRID) & sheet))
    visible = [_polygons(shapely.union_all(shapes_of_color, grid_size=GRID)) for shapes_of_color in parts]
    visible[0] = _polygons(shapely.difference(sheet, shapely.union_all(visible[1:]), grid_size=GRID))
    return tuple(visible)


def with_margin(
    regions: tuple[shapely.MultiPolygon, ...], modules: int, shape: tuple[int, int]
) -> tuple[shapely.MultiPolygon, ...]:
    """Regions on a sheet of (h, w) modules, enlarged on each side by a margin of value 0."""
    h, w = shape
    moved = [shapely.transform(region, lambda points: points + modules) for region in regions]
    frame = shapely.box(0, 0, w, h) - shapely.box(modules, modules, w - modules, h - modules)
    moved[0] = _polygons(shapely.union_all([moved[0], frame], grid_size=GRID))
    return tuple(moved)


def is_whole(regions: tuple[shapely.MultiPolygon, ...]) -> bool:
    """Whether all edges are on the lines between modules."""
    rings = shapely.get_rings(shapely.get_parts(regions))
    points, ring = shapely.get_coordinates(rings, return_index=True)
    step = np.abs(np.diff(points, axis=0))[np.diff(ring) == 0]
    return bool((np.abs(points - np.rint(points)) <= GRID).all() and (step.min(1) <= GRID).all())


def modules(regions: tuple[shapely.MultiPolygon, ...], shape: tuple[int, int]) -> np.ndarray:
    """Index of the region at the centre of each of (h, w) modules, uint8; the last of several."""
    grid = np.zeros(shape, np.uint8)
    for value, region in enumerate(regions):
        if region.is_empty:
            continue
        x0, y0, x1, y1 = np.clip(region.bounds, 0, (shape[1], shape[0]) * 2).astype(int)
        part = grid[y0 : y1 + 1, x0 : x1 + 1]
        y, x = np.indices(part.shape)
        shapely.prepare(region)
        part[shapely.intersects_xy(region, x + x0 + 0.5, y + y0 + 0.5)] = value
    return grid


def _polygons(region: shapely.Geometry) -> shapely.MultiPolygon:
    """The polygons of a region, without isolated points and lines that cuts produce."""
    return shapely.MultiPolygon([part for part in shapely.get_parts(region) if part.area])
