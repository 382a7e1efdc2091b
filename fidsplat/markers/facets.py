"""`facets`: Gaussians that are opaque and end in straight lines, because they lie in the planes of a dish.

Ordered by depth per pixel, of two opaque splats that cross the nearer one is visible on either side of the
line in which they do. So each module has a splat much larger than itself, in a plane of its own: the planes
are those of the facets of a shallow dish, of which at every point the module's own is the nearest. What a
Gaussian lacks towards the corners of its module its copies make up, and what still comes through shows its
neighbours.

It requires compositing by depth at each pixel (docs/correctness.md). With the depth of centres the same
splats occlude each other (devlog/marker-opacity.md).
"""

from __future__ import annotations

import numpy as np

from fidsplat.markers.printing import Printed, Progress
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError

DISH = 0.005
"""by how much the middles of the dish's longest edges lie before its middle, in those edges"""
RIM = (0.3, 1.5)
"""modules from the sheet's edge at which its two outermost rings of modules are cut: small facets reach
little outside, dark ones behind a quiet zone of one module too"""
SIGMA = 0.9
"""standard deviation of a facet's Gaussians, in its widths"""
COPIES = 3
"""Gaussians of a facet: those of one let 27 % through at its corners, of three 2 %"""


def count_facets(shape: tuple[int, ...]) -> int:
    """How many splats `facet_cloud` makes of a grid of modules."""
    return COPIES * int(np.prod([len(_lines(edge)) - 1 for edge in shape]))


def facet_cloud(spec: str, printed: Printed, progress: Progress) -> SplatCloud:
    """Three Gaussians for each module, in the planes of a dish that opens towards the viewer.

    Its mean depth is that of the plane z = 0; its corners lie at most `DISH` of the longest edge and a third
    before that. Splats of one facet are printed on one plane.

    Raises:
        InputError: a drawing with edges off its module grid.
    """
    if printed.angles is not None:
        raise InputError(
            f"{spec} has edges across its modules, which mixture='facets' has no splats for; take 'exact' or "
            "'fitted'"
        )
    progress("splats", 0.0)
    rows, columns = printed.grid.shape
    steepness = 4 * DISH / max(rows, columns)
    across, down = (_axis(edge, steepness) for edge in (columns, rows))
    x, width, depth_x, slope_x = np.tile(across, down.shape[1])
    y, tall, depth_y, slope_y = np.repeat(down, across.shape[1], axis=1)
    value = printed.grid[np.floor(y + rows / 2).astype(int), np.floor(x + columns / 2).astype(int)]
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
    """Where facets meet along an edge of so many modules, from its middle."""
    rim = np.array([cut for cut in RIM if cut < edge])
    return np.unique(np.concatenate([np.arange(edge + 1), rim, edge - rim])) - edge / 2


def _axis(edge: int, steepness: float) -> np.ndarray:
    """Middle, width, depth at the middle and slope of the facets along an edge, (4, n), in modules.

    The profile is a parabola of mean 0 and this steepness that opens towards the viewer, interpolated
    linearly between the lines where facets meet. It is convex: if every facet were extended to a plane, each
    would be the nearest one within its own width.
    """
    lines = _lines(edge)
    depth = steepness * (edge**2 / 12 - lines**2)
    slope = np.diff(depth) / np.diff(lines)
    return np.stack([(lines[1:] + lines[:-1]) / 2, np.diff(lines), (depth[1:] + depth[:-1]) / 2, slope])
