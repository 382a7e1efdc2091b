"""Splats and cameras of the cases: the camera is at the origin and looks along +z, x right, y down."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from fidsplat.cameras import Camera
from fidsplat.splats.arrays import all_scales
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrix_to_quaternion

ORANGE = (0.9, 0.5, 0.2)


def camera(width: int = 100, height: int = 80, focal: float = 80.0, **changes) -> Camera:
    """Pinhole camera at the origin; changes: `cx`, `cy`, `world_to_camera`, `near`, `far`."""
    center = {"cx": width / 2, "cy": height / 2}
    return Camera.pinhole(width, height, focal, focal, **center | changes)


def quaternion(tangent_u, tangent_v) -> np.ndarray:
    """Quaternion (4,) of a splat with tangents along u and v, each (3,), orthonormalised, u first."""
    u = np.asarray(tangent_u, float) / np.linalg.norm(tangent_u)
    v = np.asarray(tangent_v, float) - np.dot(tangent_v, u) * u
    v /= np.linalg.norm(v)
    return matrix_to_quaternion(np.stack([u, v, np.cross(u, v)], axis=1))


def rotation(axis, degrees: float) -> np.ndarray:
    """Quaternion (4,) of a rotation by an angle about an axis (3,)."""
    half = math.radians(degrees) / 2
    unit = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([math.cos(half), *(math.sin(half) * unit)])


def splats(
    means, quats, scales, opacities: ArrayLike = 1.0, colors: ArrayLike = ORANGE, **more
) -> SplatCloud:
    """A cloud of n splats: means (n, 3); other arguments (n, ...) or one value for all; three scales make 3D
    Gaussians."""
    n = len(means)

    def each(value, *shape) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, float), (n, *shape))

    more.setdefault("labels", np.arange(n) % 100)
    sizes = each(scales, 3 if np.shape(scales)[-1:] == (3,) else 2)
    return SplatCloud(means, each(quats, 4), sizes, each(opacities), colors=each(colors, 3), **more)


def subset_of(cloud: SplatCloud, index) -> SplatCloud:
    """The splats at an index array, in that order."""
    names = ("means", "quats", "opacities", "colors", "sh", "labels")
    arrays = {name: array[index] for name in names if (array := getattr(cloud, name)) is not None}
    arrays["scales"] = all_scales(cloud)[index]
    chosen = SplatCloud(**arrays, origin=cloud.origin)
    return (
        chosen if cloud.coplanar_groups is None else chosen.with_coplanar_groups(cloud.coplanar_groups[index])
    )
