"""Statistics of a cloud: bounds, sizes, a guess of its up axis."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_to_matrix

SHARES = (1, 50, 99)
"""percent"""
FLAT = 0.94
"""cosine of 20 degrees, the largest angle between an axis and the normal of a level splat"""
GROUND, FRONTAL = 0.2, 0.95
"""shares of the area: level areas of at least GROUND define the up axis; above FRONTAL, facing z, they are a
marker"""
SAMPLE = 100_000
"""maximum number of splats from which the up axis is guessed"""


class Up(NamedTuple):
    """A guess of the up axis."""

    axis: str
    """for example `-y`"""
    reason: str
    ground: bool
    """whether the guess follows from level areas"""

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector."""
        return (1.0 if self.axis[0] == "+" else -1.0) * np.eye(3)["xyz".index(self.axis[1])]


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
    guess = guess_up(cloud)
    facing = level_rotation(guess.direction)
    front = inner.mean(0) - facing[:, 2] * (extent @ np.abs(facing[:, 2])) / 2
    front[np.abs(front) < 1e-9 * extent.max()] = 0.0  # rounding errors of a mean
    axis = "xyz".index(guess.axis[1])
    scales = cloud.scales.astype(np.float64)
    return facts | {
        "bounds": [low, high],
        "middle_bounds": list(inner),
        "marker_position": front,
        "marker_quaternion": matrix_to_quaternion(facing),
        "up": guess.axis,
        "up_because": guess.reason,
        "height": float(extent[axis]),
        "marker_size": float(f"{0.1 * max(extent.max(), 1e-9):.1g}"),
        "scales": np.percentile(scales.max(1), SHARES),
        "aspect": float(np.median(scales.max(1) / scales.min(1))),
        "opacities": np.percentile(cloud.opacities, SHARES),
    }


def level_rotation(up) -> np.ndarray:
    """Axes of a horizontal camera for an up direction (3,), as columns (3, 3): right, down and ahead."""
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    ahead = np.cross(up, (0.0, 1.0, 0.0) if np.abs(up[1:]).max() < 1e-6 else (1.0, 0.0, 0.0))
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(-up, ahead), -up, ahead], 1) + 0.0


def guess_up(cloud: SplatCloud) -> Up:
    """The up axis of a cloud, from a sample of its splats: away from the level areas, if they are a share of
    `GROUND` and twice that of any vertical area; else along y or z if it is by far the longest side; else
    -y."""
    if not len(cloud):
        return Up("-y", "no splats", False)
    some = slice(None, None, -(-len(cloud) // SAMPLE))
    scales, means = cloud.scales[some].astype(np.float64), cloud.means[some].astype(np.float64)
    normals = quaternion_to_matrix(cloud.quats[some])[:, :, 2]
    if cloud.thickness is not None:  # a 3D Gaussian is flat along its shortest axis
        scales = np.column_stack([scales, cloud.thickness[some]])
        thin = scales.argmin(1)
        normals = quaternion_to_matrix(cloud.quats[some])[np.arange(len(thin)), :, thin]
        scales = np.sort(scales, 1)[:, 1:]
    level = np.abs(normals) > FLAT
    area = scales.prod(1) * cloud.opacities[some]
    # a few huge splats of a sky must not count as ground
    area = np.minimum(area, np.percentile(area, 99)) + 1e-30
    low, high = np.percentile(means, (0.5, 99.5), axis=0)
    shares, sides = area @ level / area.sum(), high - low
    axis = int(np.argmax(shares))
    if shares[2] > FRONTAL:
        return Up("-y", "all splats face z, like those of a marker", False)
    if shares[axis] >= max(GROUND, 2 * np.sort(shares)[1]):
        place = np.clip(means[level[:, axis], axis], low[axis], high[axis])
        below = np.average(place, weights=area[level[:, axis]]) <= (low[axis] + high[axis]) / 2
        reason = f"{100 * shares[axis]:.0f} % of the area is level"
        return Up(("+" if below else "-") + "xyz"[axis], reason, True)
    axis = int(np.argmax(sides))
    if axis > 0 and sides[axis] > 1.5 * np.sort(sides)[1]:
        return Up(("+x", "-y", "+z")[axis], "the longest side", False)
    return Up("-y", "no level areas", False)
