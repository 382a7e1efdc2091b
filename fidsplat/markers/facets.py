"""Mixture `facets`: opaque Gaussians in the planes of a shallow dish, which intersect in straight edges.

With sorting by depth at each pixel, two opaque splats that intersect have a straight visible border at the
line of intersection. Each module has a splat much larger than itself, in the plane of a facet of a shallow
dish; at every point the module's own facet is nearest. Copies fill up the opacity of a Gaussian towards the
corners of its module.

The mixture requires sorting by depth at each pixel (docs/correctness.md). With the depth of centres the
splats occlude each other (devlog/marker-opacity.md).
"""

from __future__ import annotations

import numpy as np

from fidsplat.images.apriltag3 import HOLE
from fidsplat.markers.printing import Printed
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError
from fidsplat.util.progress import Progress

DISH = 0.005
"""depth of the dish between its centre and the centres of its longest edges, relative to these edges"""
RIM = (0.3, 1.5)
"""modules from the sheet's edge at which its two outermost rings of modules are cut: small facets extend
little beyond the sheet, also dark ones behind a quiet zone of one module"""
SIGMA = 0.9
"""standard deviation of a facet's Gaussians, relative to its width"""
COPIES = 3
"""Gaussians of a facet: one transmits 27 % at the corners, three transmit 2 %"""


def count_facets(shape: tuple[int, ...]) -> int:
    """Number of splats of `facet_cloud` for a grid of modules."""
    return COPIES * int(np.prod([len(_lines(edge)) - 1 for edge in shape]))


def facet_cloud(spec: str, printed: Printed, progress: Progress) -> SplatCloud:
    """Three Gaussians for each module, in the planes of a dish that opens towards the viewer.

    The mean depth of the dish is the plane z = 0; its corners are at most `DISH` times the longest edge and a
    third in front of it. The splats of a facet are a coplanar group.

    Raises:
        InputError: a drawing with edges off its module grid.
    """
    if printed.angles is not None:
        raise InputError(
            f"mixture must be 'exact' or 'fitted' for a marker that does not consist of modules, got "
            f"'facets' for {spec}; leave it out"
        )
    progress("splats", 0.0)
    rows, columns = printed.grid.shape
    steepness = 4 * DISH / max(rows, columns)
    across, down = (_axis(edge, steepness) for edge in (columns, rows))
    x, width, depth_x, slope_x = np.tile(across, down.shape[1])
    y, tall, depth_y, slope_y = np.repeat(down, across.shape[1], axis=1)
    value = printed.grid[np.floor(y + rows / 2).astype(int), np.floor(x + columns / 2).astype(int)]
    paper = value != HOLE
    x, width, depth_x, slope_x, y, tall, depth_y, slope_y, value = (
        array[paper] for array in (x, width, depth_x, slope_x, y, tall, depth_y, slope_y, value)
    )
    means = np.column_stack([x, y, depth_x + depth_y]) * printed.module
    scales = (
        SIGMA * printed.module * np.column_stack([width * np.hypot(1, slope_x), tall * np.hypot(1, slope_y)])
    )
    # shortest rotation of (0, 0, 1) to the facet's normal (-slope_x, -slope_y, 1)
    normal = 1 / np.sqrt(1 + slope_x**2 + slope_y**2)
    quats = np.column_stack([1 + normal, slope_y * normal, -slope_x * normal, np.zeros(len(x))])
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    cloud = SplatCloud(
        np.repeat(means, COPIES, 0),
        np.repeat(quats, COPIES, 0),
        np.repeat(scales, COPIES, 0),
        np.ones(COPIES * len(x)),
        colors=np.repeat(printed.palette[value], COPIES, 0),
    )
    return cloud.with_coplanar_groups(np.repeat(np.arange(len(x)), COPIES))


def _lines(edge: int) -> np.ndarray:
    """Positions of the borders of facets along an edge of `edge` modules, from its centre."""
    rim = np.array([cut for cut in RIM if cut < edge])
    return np.unique(np.concatenate([np.arange(edge + 1), rim, edge - rim])) - edge / 2


def _axis(edge: int, steepness: float) -> np.ndarray:
    """Centre, width, depth at the centre and slope of the facets along an edge, (4, n), in modules.

    The profile is a parabola of mean 0 that opens towards the viewer, interpolated linearly between the
    borders of facets. It is convex: the plane of each facet is the nearest one within its width.
    """
    lines = _lines(edge)
    depth = steepness * (edge**2 / 12 - lines**2)
    slope = np.diff(depth) / np.diff(lines)
    return np.stack([(lines[1:] + lines[:-1]) / 2, np.diff(lines), (depth[1:] + depth[:-1]) / 2, slope])
