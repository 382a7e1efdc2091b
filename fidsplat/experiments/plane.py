"""Ideal image of a printed plane: each pixel is the exact mean of the texture over its square.

Analytic antialiasing, as in font rasterisers. A texture of square modules is constant except for jumps at
module edges, which are straight segments in a pinhole image. By Green's theorem the mean of a pixel is a sum
over segments that cross it or pass on its left: segments are cut at pixel borders, and each part contributes
its jump times its height times the fraction of the pixel on its right. The result is exact up to float64
rounding.
"""

from __future__ import annotations

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.util.errors import InputError


def plane_image(
    grid: np.ndarray,
    module: float,
    camera: Camera,
    dark: float = 0.0,
    light: float = 1.0,
    background: float = 0.5,
) -> np.ndarray:
    """Ideal image of a plane of square modules, centred at the world origin in z = 0, x right, y down.

    Args:
        grid: (h, w) uint8, 1 = dark, including the quiet zone.
        module: edge of a module in metres.
        camera: the complete plane must be beyond its near distance.
        dark, light, background: values of dark modules, light modules and the background, as display values
            or linear light.

    Returns (height, width) float64.

    Raises InputError if the plane reaches nearer than the near distance.
    """
    start, stop, jump = _edges(grid, light - dark, light - background)
    offset = np.array([grid.shape[1], grid.shape[0]]) / 2
    begin, end = (_project((points - offset) * module, camera) for points in (start, stop))
    # from behind the plane, right and left are swapped
    side = np.sign(np.linalg.det(camera.world_to_camera[:3, [0, 1, 3]]))
    return background + _accumulate(begin, end, jump * side, (camera.height, camera.width))


def _edges(grid: np.ndarray, contrast: float, paper: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges between modules of different value: start and end points (n, 2) in modules, and jumps (n,).

    A jump is the value on the right of the segment's direction (y down) minus the value on the left.
    Segments point down on vertical lines and left on horizontal lines; a run of equal jumps is one segment.
    """
    value = np.pad(paper - contrast * np.asarray(grid, np.float64), 1)  # background: 0
    across = np.diff(value, axis=1)[1:-1]  # at vertical lines, from left to right
    down = np.diff(value, axis=0)[:, 1:-1].T  # at horizontal lines, from above to below
    parts = []
    for jumps, swapped in ((across, False), (down, True)):
        # runs along each line: columns of `jumps` are lines
        all_runs = runs(jumps.T)
        line, first, last, size = (column[all_runs[3] != 0] for column in all_runs)
        a, b = np.stack([line, first], 1), np.stack([line, last], 1)
        # the right side of a segment that points down is the left side of one that points right
        parts.append((a[:, ::-1], b[:, ::-1], -size) if swapped else (a, b, size))
    start, stop, jump = (np.concatenate(column) for column in zip(*parts, strict=True))
    return start.astype(np.float64), stop.astype(np.float64), jump


def runs(values: np.ndarray) -> tuple[np.ndarray, ...]:
    """Runs of equal values in the rows of an array: row, first column, end column, value."""
    ends = np.ones((values.shape[0], values.shape[1] + 1), bool)
    ends[:, 1:-1] = values[:, 1:] != values[:, :-1]
    row, first = np.nonzero(ends[:, :-1])
    return row, first, np.nonzero(ends[:, 1:])[1] + 1, values[row, first]


def _project(points: np.ndarray, camera: Camera) -> np.ndarray:
    world = np.column_stack([points, np.zeros(len(points))])
    depth = (world - camera.position) @ camera.world_to_camera[2, :3]
    if len(depth) and depth.min() < camera.near:
        raise InputError(
            f"the plane must be beyond the near distance of {camera.near:g} m, got {depth.min():.3g} m; move "
            "the camera away"
        )
    return camera.project(world)


def _accumulate(begin: np.ndarray, end: np.ndarray, jump: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Image (h, w): sum over segments of jump times the fraction of the pixel on their right, per pixel.

    begin, end: (n, 2) pixels. jump: (n,).
    """
    h, w = shape
    which, t0, t1 = _pieces(begin, end)
    step = (end - begin)[which]
    a, b = begin[which] + step * t0[:, None], begin[which] + step * t1[:, None]
    middle = (a + b) / 2
    rise = (b[:, 1] - a[:, 1]) * jump[which]  # positive for segments that point down, since y points down
    row, column = np.floor(middle[:, 1]), np.floor(middle[:, 0])
    keep = (row >= 0) & (row < h) & (column < w) & (rise != 0)
    row, column, rise, x = row[keep].astype(int), column[keep], rise[keep], middle[keep, 0]
    # segments left of the image count completely from the first column on
    fraction = np.where(column >= 0, column + 1 - x, 1.0)
    column = np.maximum(column, 0).astype(int)
    flat = row * (w + 1) + column
    size = h * (w + 1)
    contributions = (
        np.bincount(flat, rise * fraction, size)
        + np.bincount(flat + 1, rise * (1 - fraction), size + 1)[:size]
    )
    return np.cumsum(contributions.reshape(h, w + 1), axis=1)[:, :w]


def _pieces(begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut segments at pixel borders: for each part the index of its segment, and the positions of its ends
    along the segment, 0 to 1."""
    n = len(begin)
    owner, cut = [np.arange(n), np.arange(n)], [np.zeros(n), np.ones(n)]
    for axis in (0, 1):
        low, high = np.minimum(begin, end)[:, axis], np.maximum(begin, end)[:, axis]
        first = np.floor(low) + 1
        count = np.maximum(np.ceil(high) - first, 0).astype(int)
        segments = np.repeat(np.arange(n), count)
        line = first[segments] + np.arange(len(segments)) - np.repeat(np.cumsum(count) - count, count)
        owner.append(segments)
        cut.append((line - begin[segments, axis]) / (end - begin)[segments, axis])
    who, t = np.concatenate(owner), np.clip(np.concatenate(cut), 0.0, 1.0)
    order = np.lexsort((t, who))
    who, t = who[order], t[order]
    same = who[1:] == who[:-1]
    return who[:-1][same], t[:-1][same], t[1:][same]
