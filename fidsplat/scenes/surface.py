"""Plane fit to rendered depth: the surface of a scene at a point."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fidsplat.util.arguments import direction, number
from fidsplat.util.errors import InputError

TOLERANCE = 0.1
"""maximum distance of an inlier from the plane, as a fraction of the radius of the patch"""
MIN_FRACTION = 0.5
"""minimum fraction of inliers"""
GRAZING = 0.02
"""minimum cosine between the ray and the normal"""
LIFT = 1e-3
"""distance of a marker in front of a smooth surface [m]"""
LEVEL = 0.17
"""minimum sine of the angle between the normal and the direction of a marker's upper edge"""
_TRIPLES = 128
"""number of candidate planes"""
_TUKEY = 4.685
"""threshold of Tukey's weights in standard deviations"""


@dataclass(frozen=True, eq=False)
class Surface:
    """A plane fitted to a patch of a scene's surface."""

    position: np.ndarray
    """(3,) float64, intersection of the ray and the plane in the world [m]"""
    normal: np.ndarray
    """(3,) float64 unit vector in the world, towards the camera"""
    inlier_fraction: float
    """fraction of inliers among the pixels of the patch, 0.5 to 1"""
    roughness: float
    """RMS distance of the inliers from the plane [m]"""
    radius: float
    """radius of the patch [m]"""

    def pose(self, ups: Iterable, lift: float | None = None) -> np.ndarray:
        """world_from_marker (4, 4) float64 of a marker on the surface.

        Args:
            ups: (k, 3) world directions towards its upper edge; the first one more than 10 degrees from the
                normal is used.
            lift: distance in front of the surface [m]; None: 1 mm plus twice the roughness.
        """
        lift = LIFT + 2 * self.roughness if lift is None else number("lift", lift)
        for up in ups:
            top = direction("up", up)
            top = top - (top @ self.normal) * self.normal
            if np.linalg.norm(top) >= LEVEL:
                break
        top = top / np.linalg.norm(top)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([np.cross(top, self.normal), -top, -self.normal], 1) + 0.0
        matrix[:3, 3] = self.position + lift * self.normal
        return matrix


def fit_surface(points: np.ndarray, origin: np.ndarray, ray: np.ndarray, radius: float) -> Surface:
    """Fit the dominant plane of points by MSAC, then by least squares with Tukey's weights, and intersect it
    with a ray.

    Args:
        points: (n, 3) world points of a patch, one for each pixel; NaN for empty pixels.
        origin, ray: (3,) origin and direction of the ray.
        radius: radius of the patch [m].

    Raises:
        InputError: less than half of the pixels are in one plane, or the ray is parallel to it.
    """
    filled = points[np.isfinite(points).all(1)]
    fraction = len(filled) / max(len(points), 1)
    if fraction < MIN_FRACTION or len(filled) < 3:
        raise InputError(_refusal(f"{100 - 100 * fraction:.0f} % of the patch without splats"))
    center = filled.mean(0)
    local, tolerance = filled - center, TOLERANCE * radius
    triples = np.random.default_rng(0).integers(0, len(local), (_TRIPLES, 3))
    a, b, c = (local[triples[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    lengths = np.linalg.norm(normals, axis=1)
    usable = lengths > 1e-12 * radius**2
    if not usable.any():
        raise InputError(_refusal("points of one line"))
    normals, a = normals[usable] / lengths[usable, None], a[usable]
    distances = np.abs(local @ normals.T - (a * normals).sum(1))
    best = int(np.argmin((np.minimum(distances, tolerance) ** 2).sum(0)))
    normal, middle = normals[best], a[best]
    for _ in range(10):
        residuals = (local - middle) @ normal
        inside = np.abs(residuals) <= tolerance
        if inside.sum() < 3:
            break
        scale = max(1.4826 * float(np.median(np.abs(residuals[inside]))), 1e-7 * radius)
        weights = np.clip(1 - (residuals / min(_TUKEY * scale, tolerance)) ** 2, 0, None) ** 2
        middle = weights @ local / weights.sum()
        moment = (local - middle).T @ ((local - middle) * weights[:, None])
        before, normal = normal, np.linalg.eigh(moment)[1][:, 0]
        if 1 - abs(before @ normal) < 1e-15:
            break
    residuals = (local - middle) @ normal
    inside = np.abs(residuals) <= tolerance
    fraction = float(inside.sum() / len(points))
    if fraction < MIN_FRACTION:
        raise InputError(_refusal(f"{100 * fraction:.0f} %"))
    ray = ray / np.linalg.norm(ray)
    slope = float(ray @ normal)
    if abs(slope) < GRAZING:
        raise InputError(
            f"the ray must meet the surface at an angle of at least {np.degrees(np.arcsin(GRAZING)):.1f} "
            f"degrees, got {np.degrees(np.arcsin(abs(slope))):.1f}; give another pixel or a camera in front "
            "of the surface"
        )
    normal = -np.sign(slope) * normal
    distance = float((center + middle - origin) @ normal) / -abs(slope)
    rms = float(np.sqrt(np.mean(residuals[inside] ** 2)))
    return Surface(origin + distance * ray, normal, fraction, rms, float(radius))


def _refusal(got: str) -> str:
    return (
        f"the surface must be one plane in at least {100 * MIN_FRACTION:.0f} % of the patch, got {got}; "
        "give another pixel or radius"
    )
