"""Statistics of a cloud: bounds, sizes, a guess of its up axis."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_to_matrix

SHARES = (1, 50, 99)
"""percent"""
FLAT = 0.94
"""cosine of 20 degrees, the largest angle between an axis and the normal of a level splat"""


def describe(cloud: SplatCloud) -> dict[str, Any]:
    """Figures of a cloud: lengths in the file's metres, percentiles of `SHARES`."""
    facts: dict[str, Any] = {
        "splats": len(cloud),
        "kind": "2D" if cloud.thickness is None else "3D",
        "sh_degree": max(cloud.sh_degree, 0),
        "left_out": dict(cloud.dropped),
    }
    if not len(cloud):
        return facts
    low, high = cloud.bounds()
    inner = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0) + cloud.origin
    extent = inner[1] - inner[0]
    front = np.array([*inner.mean(0)[:2], inner[0, 2]])
    front[np.abs(front) < 1e-9 * extent.max()] = 0.0  # rounding errors of a mean
    up, why = guess_up(cloud)
    axis = "xyz".index(up[1])
    scales = cloud.scales.astype(np.float64)
    return facts | {
        "bounds": [low, high],
        "middle_bounds": list(inner),
        "marker_position": front,
        "up": up,
        "up_because": why,
        "height": float(extent[axis]),
        "marker_size": float(f"{0.1 * max(extent.max(), 1e-9):.1g}"),
        "scales": np.percentile(scales.max(1), SHARES),
        "aspect": float(np.median(scales.max(1) / scales.min(1))),
        "opacities": np.percentile(cloud.opacities, SHARES),
    }


def guess_up(cloud: SplatCloud) -> tuple[str, str]:
    """The up axis, for example "-y", and the reason: away from the level areas, or along a side that is by
    far the longest."""
    level = np.abs(quaternion_to_matrix(cloud.quats)[:, :, 2]) > FLAT
    area = cloud.scales.prod(1).astype(np.float64) * cloud.opacities
    area = (
        np.minimum(area, np.percentile(area, 99)) + 1e-30
    )  # a few huge splats of a sky must not count as ground
    low, high = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0)
    shares, sides = area @ level / area.sum(), np.sort(high - low)
    axis = int(np.argmax(shares))
    if shares[axis] < 0.5 and sides[2] > 1.5 * sides[1]:
        axis = int(np.argmax(high - low))
        return ("+x", "-y", "+z")[axis], "the longest side"
    some = level[:, axis] if level[:, axis].any() else np.ones(len(cloud), bool)
    place = np.clip(cloud.means[some, axis], low[axis], high[axis])
    below = np.average(place, weights=area[some]) <= (low[axis] + high[axis]) / 2
    return ("+" if below else "-") + "xyz"[axis], f"{100 * shares[axis]:.0f} % of the area is level"
