"""Visible part of a marker in an image."""

from typing import NamedTuple

import numpy as np
import shapely

from fidsplat.cameras import Camera, Orthographic
from fidsplat.scenes import PlacedMarker

MARGIN = 1
"""Modules of the quiet zone that belong to a marker's outline, since detectors require them."""

POINTS = 16
"""Samples along a side, which is curved by lenses, and cells of a bent sheet along an edge."""

GRID = 1e-6
"""Pixels to which the corners of the cells of a bent sheet are rounded."""


class Visible(NamedTuple):
    """Visible fraction and bounding box of a marker."""

    fraction: float
    """visible fraction of its outline in an unbounded image, 0 to 1"""
    box: tuple[float, float, float, float] | None
    """bounding box in pixels x0, y0, x1, y1, without occlusion; None for a fraction of 0"""


def visible_part(placed: PlacedMarker, camera: Camera) -> tuple[shapely.Geometry, shapely.Geometry]:
    """Outline of a marker in an unbounded image, and its part in the camera's image, in pixels.

    The outline has one module of the quiet zone, if there is one. Both are empty for a marker that faces
    away. That of a bent marker is the union of its parts that face the camera.
    """
    marker = placed.marker
    margin = min(MARGIN, marker.quiet_zone) * marker.module
    corners = marker.flat_corners + margin * np.sign(marker.flat_corners)
    area = (_flat if marker.shape is None else _bent)(placed, camera, corners)
    return area, shapely.intersection(area, shapely.box(0, 0, camera.width, camera.height))


def _flat(placed: PlacedMarker, camera: Camera, corners: np.ndarray) -> shapely.Geometry:
    """Image of a rectangle (4, 2) of a flat sheet."""
    points = placed.marker.points(corners) @ placed.pose[:3, :3].T + placed.pose[:3, 3]
    parallel = isinstance(camera.lens, Orthographic)
    if not parallel and (points[0] - camera.position) @ placed.pose[:3, 2] <= 0:
        return shapely.Polygon()  # the camera is behind the sheet
    if camera.lens is None or parallel:
        depth = points @ camera.world_to_camera[2, :3] + camera.world_to_camera[2, 3]
        points = points if (depth > camera.near).all() else _clipped(points, depth - camera.near)
    else:  # sides are curved
        fraction = np.arange(POINTS)[:, None] / POINTS
        points = np.concatenate(
            [a + fraction * (b - a) for a, b in zip(points, np.roll(points, -1, 0), strict=True)]
        )
    at = camera.project(points)
    at = at[np.isfinite(at).all(1)]
    return shapely.Polygon(at).buffer(0) if _area(at) > 0 else shapely.Polygon()  # as printed, clockwise


def _bent(placed: PlacedMarker, camera: Camera, corners: np.ndarray) -> shapely.Geometry:
    """Image of a rectangle (4, 2) of a bent sheet: the union of its cells that face the camera."""
    lines = [np.linspace(low, high, POINTS + 1) for low, high in zip(corners[0], corners[2], strict=True)]
    points = placed.marker.points(np.stack(np.meshgrid(*lines), -1).reshape(-1, 2))
    at = camera.project(points @ placed.pose[:3, :3].T + placed.pose[:3, 3]).reshape(
        POINTS + 1, POINTS + 1, 2
    )
    cells = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]], 2).reshape(-1, 4, 2)
    cells = cells[np.isfinite(cells).all((1, 2))]
    facing = cells[_area(cells) > 0]
    return shapely.union_all(shapely.make_valid(shapely.polygons(facing)), grid_size=GRID)


def _area(polygons: np.ndarray) -> np.ndarray:
    """Twice the areas (...) of polygons (..., n, 2), above 0 for clockwise ones."""
    after = np.roll(polygons, -1, -2)
    return (polygons[..., 0] * after[..., 1] - polygons[..., 1] * after[..., 0]).sum(-1)


def visible(placed: PlacedMarker, camera: Camera, label: np.ndarray | None = None) -> Visible:
    """Visible fraction and bounding box of a marker's outline.

    label: (h, w) int32, the labels of the image; None: no occlusion.
    """
    area, part = visible_part(placed, camera)
    if shapely.is_empty(part):
        return Visible(0.0, None)
    fraction = min(float(shapely.area(part) / shapely.area(area)), 1.0)
    x0, y0, x1, y1 = shapely.bounds(part).tolist()
    if label is not None:
        bounds = int(x0), int(y0), min(int(x1) + 1, camera.width), min(int(y1) + 1, camera.height)
        inside = _raster(part, *bounds)
        labelled = label[bounds[1] : bounds[3], bounds[0] : bounds[2]] == placed.label
        fraction *= np.count_nonzero(labelled & inside) / max(np.count_nonzero(inside), 1)
    return Visible(fraction, (x0, y0, x1, y1))


def _raster(area: shapely.Geometry, x0: int, y0: int, x1: int, y1: int) -> np.ndarray:
    """Mask (y1 - y0, x1 - x0) of the pixels whose centres are in polygons, by scanlines and the even-odd
    rule."""
    at, ring = shapely.get_coordinates(shapely.get_rings(shapely.get_parts(area)), return_index=True)
    at = at - (x0 + 0.5, y0 + 0.5)
    a, b = (ends[ring[1:] == ring[:-1]] for ends in (at[:-1], at[1:]))
    first, end = np.ceil(np.sort([a[:, 1], b[:, 1]], 0)).astype(int)  # rows that an edge crosses
    edge = np.repeat(np.arange(len(a)), end - first)
    row = np.arange(len(edge)) + np.repeat(first - np.cumsum(end - first) + end - first, end - first)
    a, b = a[edge], b[edge]
    x = a[:, 0] + (row - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    toggles = np.zeros((y1 - y0, x1 - x0 + 1), np.uint8)
    np.add.at(toggles, (row, np.clip(np.ceil(x), 0, x1 - x0).astype(int)), 1)
    return np.cumsum(toggles[:, :-1], 1, np.uint8) % 2 > 0


class Outline(NamedTuple):
    """Outline of a marker in an image, with its visible part."""

    area: float
    """area in square pixels in an unbounded image"""
    box: tuple[float, float, float, float] | None
    """bounding box in pixels x0, y0, x1, y1; None for a marker that faces away"""
    visible_area: float
    """square pixels of the part in the camera's image"""
    polygons: list[np.ndarray]
    """polygons (n, 2) in pixels of the visible part"""


def outline(placed: PlacedMarker, camera: Camera) -> Outline:
    """Outline of a marker in a camera's image."""
    area, part = visible_part(placed, camera)
    parts = [p for p in shapely.get_parts(part) if p.geom_type == "Polygon"]
    box = None if shapely.is_empty(area) else tuple(shapely.bounds(area).tolist())
    rings = [shapely.get_coordinates(shapely.get_exterior_ring(p))[:-1] for p in parts]
    return Outline(float(shapely.area(area)), box, float(shapely.area(part)), rings)


def _clipped(points: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Part of a polygon (n, 3) where a linear function is positive; ahead: its values at the corners."""
    clipped = []
    for a, b, at_a, at_b in zip(points, np.roll(points, -1, 0), ahead, np.roll(ahead, -1), strict=True):
        if at_a > 0:
            clipped.append(a)
        if (at_a > 0) != (at_b > 0):
            clipped.append(a + at_a / (at_a - at_b) * (b - a))
    return np.array(clipped).reshape(-1, 3)
