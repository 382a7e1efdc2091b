"""Statistics of a cloud: bounds, sizes, a guess of its up axis."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_to_matrix

PERCENTILES = (1, 50, 99)
MIN_LEVEL_COSINE = 0.94
"""cosine of 20 degrees, the largest angle between an axis and the normal of a level splat"""
MIN_GROUND, MIN_MARKER = 0.2, 0.95
"""fractions of the splats' area: minimum of level splats that define the up axis; minimum of splats that face
z in a marker"""
MAX_SAMPLE = 100_000
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
    """Statistics of a cloud by name: lengths in metres, percentiles of `PERCENTILES`."""
    facts: dict[str, Any] = {
        "splats": len(cloud),
        "kind": "2D" if cloud.thickness is None else "3D",
        "sh_degree": max(cloud.sh_degree, 0),
        "left_out": dict(cloud.dropped),
    }
    if not len(cloud):
        return facts
    low, high = cloud.bounds()
    percentile_box = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0) + cloud.origin
    extent = percentile_box[1] - percentile_box[0]
    guess = guess_up(cloud)
    axes = level_rotation(guess.direction)
    position = percentile_box.mean(0) - axes[:, 2] * (extent @ np.abs(axes[:, 2])) / 2
    position[np.abs(position) < 1e-9 * extent.max()] = 0.0  # rounding errors of a mean
    axis = "xyz".index(guess.axis[1])
    scales = cloud.scales.astype(np.float64)
    return facts | {
        "bounds": [low, high],
        "middle_bounds": list(percentile_box),
        "marker_position": position,
        "marker_quaternion": matrix_to_quaternion(axes),
        "up": guess.axis,
        "up_because": guess.reason,
        "height": float(extent[axis]),
        "marker_size": float(f"{0.1 * max(extent.max(), 1e-9):.1g}"),
        "scales": np.percentile(scales.max(1), PERCENTILES),
        "aspect": float(np.median(scales.max(1) / scales.min(1))),
        "opacities": np.percentile(cloud.opacities, PERCENTILES),
    }


def level_rotation(up) -> np.ndarray:
    """Axes of a horizontal camera for an up direction (3,), as columns (3, 3): right, down and ahead."""
    up = np.asarray(up, np.float64) / np.linalg.norm(up)
    ahead = np.cross(up, (0.0, 1.0, 0.0) if np.abs(up[1:]).max() < 1e-6 else (1.0, 0.0, 0.0))
    ahead /= np.linalg.norm(ahead)
    return np.stack([np.cross(-up, ahead), -up, ahead], 1) + 0.0


def guess_up(cloud: SplatCloud) -> Up:
    """The up axis of a cloud, from a sample of its splats: away from the level areas, if their fraction is
    at least `MIN_GROUND` and twice that of any vertical area; else along y or z if it is by far
    the longest side; else -y."""
    if not len(cloud):
        return Up("-y", "no splats", False)
    sample = slice(None, None, -(-len(cloud) // MAX_SAMPLE))
    scales, means = cloud.scales[sample].astype(np.float64), cloud.means[sample].astype(np.float64)
    normals = quaternion_to_matrix(cloud.quats[sample])[:, :, 2]
    if cloud.thickness is not None:  # a 3D Gaussian is flat along its shortest axis
        scales = np.column_stack([scales, cloud.thickness[sample]])
        thinnest = scales.argmin(1)
        normals = quaternion_to_matrix(cloud.quats[sample])[np.arange(len(thinnest)), :, thinnest]
        scales = np.sort(scales, 1)[:, 1:]
    level = np.abs(normals) > MIN_LEVEL_COSINE
    area = scales.prod(1) * cloud.opacities[sample]
    # a few huge splats of a sky must not count as ground
    area = np.minimum(area, np.percentile(area, 99)) + 1e-30
    low, high = np.percentile(means, (0.5, 99.5), axis=0)
    fractions, sides = area @ level / area.sum(), high - low
    axis = int(np.argmax(fractions))
    if fractions[2] > MIN_MARKER:
        return Up("-y", "all splats face z, like those of a marker", False)
    if fractions[axis] >= max(MIN_GROUND, 2 * np.sort(fractions)[1]):
        coordinates = np.clip(means[level[:, axis], axis], low[axis], high[axis])
        ground_is_low = np.average(coordinates, weights=area[level[:, axis]]) <= (low[axis] + high[axis]) / 2
        reason = f"{100 * fractions[axis]:.0f} % of the area is level"
        return Up(("+" if ground_is_low else "-") + "xyz"[axis], reason, True)
    axis = int(np.argmax(sides))
    if axis > 0 and sides[axis] > 1.5 * np.sort(sides)[1]:
        return Up(("+x", "-y", "+z")[axis], "the longest side", False)
    return Up("-y", "no level areas", False)
