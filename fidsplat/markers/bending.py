"""Bending of a marker's sheet: subdivision of its rectangles by curvature, and their poses on a surface.

A flat rectangle is tangential to the surface at its centre. It is halved until its distance from the surface,
at equal positions on the sheet, is at most a bound.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from fidsplat.markers.printing import Printed, refuse_more
from fidsplat.markers.surfaces import Frames, SheetShape
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrices_to_quaternions, quaternion_multiply

FINE = 2500
"""The default bound of the deviation is the size of the marker divided by this number."""

GAP = 2
"""Maximum distance between the planes of two neighbouring pieces, relative to the deviation of each"""

SAMPLES = 5
"""samples of the distance along each edge of a rectangle"""

MARGIN = 0.9
"""maximum deviation at samples as a fraction of the bound, which the deviation between samples may reach"""

TURN = np.radians(30)
"""Maximum rotation of the normal within a coplanar group. A layer has no order, so that the two sides of a
sheet that occludes itself must be in different groups."""

CELLS = 8
"""Gaussians have pieces of at least 1 / 8 module"""


def fine(printed: Printed) -> Printed:
    """The same rectangles on a grid whose cells are `CELLS` times smaller."""
    return printed._replace(
        grid=printed.grid.repeat(CELLS, 0).repeat(CELLS, 1),
        boxes=printed.boxes * CELLS,
        module=printed.module / CELLS,
    )


def subdivide(
    spec: str, printed: Printed, surface: SheetShape, deviation: float, max_splats: int, whole: bool = False
) -> Printed:
    """Halve rectangles until they deviate from a surface by at most a bound.

    deviation: metres. whole: cut only at edges of modules; a rectangle of one module is not cut, even if it
    deviates more.

    Raises InputError for more than `max_splats` pieces.
    """
    boxes, owner = printed.boxes.astype(np.float64), np.arange(len(printed.boxes))
    done_boxes, done_owner, done = [], [], 0
    while len(boxes):
        length = boxes[:, 2:] - boxes[:, :2]
        deviations, by_axis = _deviations(printed, surface, boxes, owner)
        if surface.across is not None:
            width = length * printed.module * (np.abs(surface.across) if printed.angles is None else 1.0)
            by_axis = np.where(width > surface.longest(deviation), width, by_axis)
        halved = (np.maximum(deviations, by_axis.max(1)) > MARGIN * deviation) & ~(
            whole & (length.max(1) <= 1)
        )
        done_boxes.append(boxes[~halved])
        done_owner.append(owner[~halved])
        done += len(boxes) - int(halved.sum())
        boxes, owner, by_axis = boxes[halved], owner[halved], by_axis[halved]
        refuse_more(f"on its surface {spec}", done + 2 * len(boxes), max_splats, "at least ")
        angles = None if printed.angles is None else printed.angles[owner]
        boxes = _halves(boxes, by_axis, MARGIN * deviation / 2, whole, angles)
        owner = np.concatenate([owner, owner])
    pieces, owner = np.concatenate(done_boxes), np.concatenate(done_owner)
    order = np.argsort(owner, kind="stable")
    pieces, owner = pieces[order], owner[order]
    return printed._replace(
        boxes=np.rint(pieces).astype(np.int64) if whole else pieces,
        values=printed.values[owner],
        angles=None if printed.angles is None else printed.angles[owner],
    )


def _halves(
    boxes: np.ndarray, by_axis: np.ndarray, straight_below: float, whole: bool, angles: np.ndarray | None
) -> np.ndarray:
    """The first halves of rectangles (n, 4), then the second ones."""
    # a twisted rectangle has straight lines along its axes
    length = boxes[:, 2:] - boxes[:, :2]
    straight = by_axis.max(1) < straight_below
    axis = np.where(straight, length[:, 1] > length[:, 0], by_axis[:, 1] > by_axis[:, 0]).astype(int)
    rows = np.arange(len(boxes))
    if whole:
        axis = np.where(length[rows, axis] > 1, axis, 1 - axis)
    middle = (boxes[rows, axis] + boxes[rows, axis + 2]) / 2
    middle = np.floor(middle) if whole else middle
    first, second = boxes.copy(), boxes.copy()
    first[rows, axis + 2] = second[rows, axis] = middle
    if angles is not None:  # pieces rotate about their own centres
        first, second = (_rotated(piece, boxes, angles) for piece in (first, second))
    return np.concatenate([first, second])


def _rotated(pieces: np.ndarray, boxes: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Pieces of rotated boxes, moved such that a rotation of each piece about its own centre has the same
    result as the rotation of its box about the centre of the box."""
    before, about = ((array[:, :2] + array[:, 2:]) / 2 for array in (pieces, boxes))
    (x, y), c, s = (before - about).T, np.cos(angles), np.sin(angles)
    step = about + np.column_stack([c * x - s * y, s * x + c * y]) - before
    return pieces + np.tile(step, 2)


def _deviations(
    printed: Printed, surface: SheetShape, boxes: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Maximum distances of rectangles from a surface: (n,), and (n, 2) along the rectangles' axes."""
    module, middle = printed.module, np.array(printed.grid.shape[::-1]) / 2
    center = ((boxes[:, :2] + boxes[:, 2:]) / 2 - middle) * module
    half = (boxes[:, 2:] - boxes[:, :2]) * (module / 2)
    offsets = np.linspace(-1, 1, SAMPLES)
    steps = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    offset = half[:, None] * steps
    if printed.angles is not None:
        c, s = np.cos(printed.angles[owner])[:, None], np.sin(printed.angles[owner])[:, None]
        x, y = offset[..., 0], offset[..., 1]
        offset = np.stack([c * x - s * y, s * x + c * y], -1)
    at = surface.frames(center)
    true = surface.frames((center[:, None] + offset).reshape(-1, 2)).points.reshape(*offset.shape[:2], 3)
    flat = at.points[:, None] + offset[..., :1] * at.along_x[:, None] + offset[..., 1:] * at.along_y[:, None]
    distances = np.linalg.norm(true - flat, axis=2)
    on_axis = [distances[:, steps[:, 1 - axis] == 0].max(1) for axis in (0, 1)]
    return distances.max(1), np.column_stack(on_axis)


def bend(
    cloud: SplatCloud, surface: SheetShape, half: tuple[float, float], overlap: float, deviation: float
) -> SplatCloud:
    """Move the splats of a flat sheet to the tangent planes of a surface.

    half: half edges of the sheet in metres. deviation: deviation of the pieces from the surface [m]. Boxes
    are extended by the largest distance between neighbouring planes. Splats up to `overlap` metres from the
    border of a coplanar group are in both groups, so that there is no gap between the groups; the copy is
    farther from the viewer by the same distance, and occluded elsewhere.
    """
    gap = GAP * deviation
    at = surface.frames(cloud.means[:, :2].astype(np.float64))
    rotations = np.stack([at.along_x, at.along_y, at.normals], -1)
    quats = quaternion_multiply(matrices_to_quaternions(rotations), cloud.quats).astype(np.float32)
    scales = cloud.scales if cloud.boxes is None else (cloud.scales + gap).astype(np.float32)
    rows, groups, copies = _groups(cloud, surface, half, overlap)
    means = at.points[rows] + np.where(copies, gap, 0.0)[:, None] * at.normals[rows]
    bent = SplatCloud.from_validated(
        means.astype(np.float32),
        quats[rows],
        scales[rows],
        cloud.opacities[rows],
        colors=None if cloud.colors is None else cloud.colors[rows],
        origin=np.zeros(3),
        dropped={},
    )
    return (bent if cloud.boxes is None else bent.with_boxes()).with_coplanar_groups(groups)


def _groups(
    cloud: SplatCloud, surface: SheetShape, half: tuple[float, float], overlap: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of the splats of all coplanar groups, their groups, and whether they are copies from a
    neighbour."""
    way, every = surface.across, np.arange(len(cloud))
    extent = 0.0 if way is None else float(np.abs(way) @ half)
    borders = [] if way is None else _borders(surface, way, -extent, extent)
    if way is None or len(borders) == 2:
        return every, np.zeros(len(cloud), np.int32), np.zeros(len(cloud), bool)
    middle, half_extent = cloud.means[:, :2] @ way, cloud.half_extents(2.0)[:, :2] @ np.abs(way)
    home_group = np.searchsorted(borders[1:-1], middle)
    rows = [
        np.flatnonzero(
            (middle + half_extent > low - overlap) & (middle - half_extent < high + overlap)
            | (home_group == number)
        )
        for number, (low, high) in enumerate(pairwise(borders))
    ]
    groups = np.repeat(np.arange(len(rows), dtype=np.int32), [len(row) for row in rows])
    row_indices = np.concatenate(rows)
    return row_indices, groups, home_group[row_indices] != groups


def _borders(surface: SheetShape, way: np.ndarray, low: float, high: float) -> list[float]:
    """Positions across a surface between which its normal rotates by at most `TURN`."""
    normals = surface.frames(np.linspace(low, high, 65)[:, None] * way).normals
    if np.arccos(np.clip(normals @ normals.T, -1, 1)).max() <= TURN:
        return [low, high]
    middle = (low + high) / 2
    return [*_borders(surface, way, low, middle), *_borders(surface, way, middle, high)[1:]]


def surface_frames(surface: SheetShape | None, xy: np.ndarray) -> Frames:
    """Points and tangents at positions (n, 2) on a sheet. surface: None for a flat sheet."""
    if surface is not None:
        return surface.frames(xy)
    along = np.zeros((2, len(xy), 3))
    along[0, :, 0] = along[1, :, 1] = 1
    return Frames(np.column_stack([xy, np.zeros(len(xy))]), *along)
