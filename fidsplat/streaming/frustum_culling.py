"""Frustum culling of bounding boxes, and bounds of their projected size.

A box contains the splats of a chunk of a store (scene on disk), or of a part of a chunk. The test is
conservative for every camera model, low-pass and shutter: a culled box contains no splat that contributes to
the frame. It applies the criteria of `project.cl` to all splats that a box can contain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fidsplat.backends.view import View
from fidsplat.cameras.lenses import BrownConrady, Equirectangular, Fisheye, RayTable
from fidsplat.cameras.raster import RayRaster
from fidsplat.effects import FeatureSet
from fidsplat.store.merge import MAX_OPACITY

BoundingBoxes = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""function of a number of standard deviations that returns the minimum and maximum corners (n, 3) float64 [m]
of bounding boxes of the splats to that extent"""

PADDING = 1.01
"""factor that enlarges the extent of splats, for rounding errors"""
_FILTER_ACROSS, _FILTER_ALONG = 0.5, 1 / 8
"""standard deviations of the filter of the low-pass `pixel`: across the ray in samples, and along it as a
fraction of the depth (kernels/opencl/effect/lowpass_pixel.cl)"""
_ROUNDING = 1e-5
"""relative error of a coordinate that projection in float32 computes"""


def in_frustum(view: View, features: FeatureSet, boxes: BoundingBoxes, max_sigma: np.ndarray) -> np.ndarray:
    """Frustum culling: mask (n,) of the boxes whose splats may contribute to the frame, at any pose of the
    shutter and of moving groups.

    max_sigma: (n,) largest standard deviation of each box's splats [m].
    """
    if view.sub_frames:
        visible = np.zeros(len(max_sigma), bool)
        for sub_frame in view.sub_frames:
            visible |= in_frustum(sub_frame.view, features, boxes, max_sigma)
        return visible
    visible = _in_frustum_of_pose(view, features, boxes, max_sigma)
    for _, group_view in view.groups:
        visible |= _in_frustum_of_pose(group_view, features, boxes, max_sigma)
    return visible


@dataclass(frozen=True)
class Extent:
    """Bounds on the extent of splats around their centres p, in the camera's frame.

    The low-pass `pixel` adds an ellipse in the disk's plane to a disk of R standard deviations: by the
    derivative at p, its points e are at most R s samples to the side and R k z in depth, with z the depth
    of p, s = `_FILTER_ACROSS` and k = `_FILTER_ALONG`. A side of the image is a plane through the camera's
    centre, at a distance of n . p / z samples from p; a displacement e scales this distance by 1 + e_z / z
    and adds the samples to the side. Covariances add: a point p beyond a side, d = -n . p, reaches over the
    side only if d^2 <= R^2 (E^2 + (k d)^2 + (s z)^2), with E the disk's standard deviation along n. A disk
    and a margin enlarged by 1 / sqrt(1 - (R k)^2) that are beyond the side do not. The bound on depths is the
    sum: z - R k z, less the disk's own extent. The low-pass does not change splats whose centre is in front
    of the near plane.
    """

    radius: float
    """extent of disks to the sides, in standard deviations"""
    margin: float
    """margin around their projection [samples]"""
    depth_radius: float
    """extent of disks along z, in standard deviations"""
    depth_factor: float = 1.0
    """factor by which the low-pass `pixel` reduces the depth of the nearest point"""

    @staticmethod
    def of(view: View, features: FeatureSet, minimum: float = 0.0) -> Extent | None:
        """The extent of a view's splats, of at least `minimum` standard deviations; None if it is unbounded.

        With the low-pass `pixel`, it is unbounded for distorted lenses, for parallel rays and for alpha
        cut-offs below about 1e-13.
        """
        radius = max(cutoff_radius(view), minimum)
        # margin for the low-pass filter `screen`, or for that of EWA
        plain = Extent(radius, radius * view.samples + 2.0, radius)
        if not _has_pixel_lowpass(features):
            return plain
        # bounding spheres of disks bound depths along the ray; they include the sideways extent
        max_angle = _FILTER_ACROSS * _max_ray_rotation(view) if view.along_ray else 0.0
        nearer = 1.0 - radius * math.hypot(_FILTER_ALONG, max_angle)
        if nearer <= 0 or view.parallel or isinstance(view.lens, BrownConrady):
            return None
        enlarged = 1.0 / math.sqrt(1.0 - (radius * _FILTER_ALONG) ** 2)
        margin = max(plain.margin, enlarged * radius * _FILTER_ACROSS + 2.0)
        return Extent(enlarged * radius, margin, radius / nearer, nearer)

    def nearest(self, view: View, boxes: CameraBoxes) -> np.ndarray:
        """Lower bounds (n,) on depths [m]. boxes: boxes to `depth_radius` standard deviations."""
        nearest = boxes.nearest(view)
        return np.minimum(self.depth_factor * nearest, nearest)


def _has_pixel_lowpass(features: FeatureSet) -> bool:
    return "lowpass_pixel" in features.names


def cutoff_radius(view: View) -> float:
    """Radius [standard deviations] at which the alpha of the most opaque splats is the cut-off, padded."""
    return PADDING * math.sqrt(2.0 * (math.log(MAX_OPACITY) - view.log_alpha_cutoff))


def ewa_extent(view: View, features: FeatureSet, radius: float, max_sigma: np.ndarray) -> np.ndarray | None:
    """Radius (n,) of EWA footprints around projected centres, in samples times depth [m]; None without EWA.

    EWA projects by the derivative at the centre, so that a footprint can be larger than the projected splat.
    radius: extent in standard deviations. max_sigma: (n,) largest standard deviations [m].
    """
    if not {"ellipsoid_ewa", "ellipsoid_ewa_antialiased"} & features.names:
        return None
    slope = 1.0 if view.parallel else math.hypot(1.0, max(map(abs, view.ewa_clamp)))
    return max(view.focal_x, view.focal_y) * slope * radius * max_sigma


def _in_frustum_of_pose(
    view: View, features: FeatureSet, boxes: BoundingBoxes, max_sigma: np.ndarray
) -> np.ndarray:
    extent = Extent.of(view, features)
    if extent is None:
        # the low-pass filter does not change splats whose centre is behind the near plane
        disks = CameraBoxes(view, *boxes(cutoff_radius(view)))
        return disks.furthest(view) >= view.near * (1 - _ROUNDING)
    radius, margin = extent.radius, extent.margin
    centers = CameraBoxes(view, *boxes(0.0))
    disks = CameraBoxes(view, *boxes(radius))
    visible = disks.furthest(view) >= view.near * (1 - _ROUNDING)
    deep_boxes = disks if extent.depth_radius == radius else CameraBoxes(view, *boxes(extent.depth_radius))
    visible &= extent.nearest(view, deep_boxes) <= view.far * (1 + _ROUNDING)
    if view.raster is None:
        ewa_radius = ewa_extent(view, features, radius, max_sigma)
        for normal, offset in _pinhole_sides(view, margin):
            inside = disks.support(normal) + offset >= 0
            if ewa_radius is not None:
                inside |= centers.support(normal) + offset + ewa_radius >= 0
            visible &= inside
        return visible
    lens = view.raster.lens
    if isinstance(lens, Equirectangular | RayTable):
        return visible
    slack = view.raster.max_ray_derivative * margin
    if isinstance(lens, Fisheye):
        if _has_pixel_lowpass(features):
            slack = _max_ray_rotation(view) * max(margin, extent.depth_radius * _FILTER_ACROSS + 2.0)
            displacement = extent.depth_radius * max_sigma
            return visible & centers.within_angle(_max_ray_angle(view.raster), slack, displacement)
        return visible & disks.within_angle(_max_ray_angle(view.raster) + slack)
    low, high = _slopes(view.raster)
    for axis in (0, 1):
        for sign, edge_slope in ((1.0, low[axis] - slack), (-1.0, high[axis] + slack)):
            normal = np.zeros(3)
            normal[axis], normal[2] = sign, -sign * edge_slope
            visible &= disks.support(normal) >= 0
    return visible


class CameraBoxes:
    """Bounding boxes in the camera's frame."""

    def __init__(self, view: View, low: np.ndarray, high: np.ndarray) -> None:
        middle, half = (low + high) / 2, (high - low) / 2
        self.middle = middle @ view.rotation.T + view.translation
        self.half = half @ np.abs(view.rotation.T)
        self._low, self._high, self._view = low, high, view
        # rounding error of the sums that yield a coordinate
        self.rounding = _ROUNDING * (np.abs(middle).sum(1) + half.sum(1) + np.abs(view.translation).sum())
        self._half = half

    def support(self, normal: np.ndarray) -> np.ndarray:
        """Support function of each box (n,): the largest dot product of its points with a vector (3,)."""
        extent = self._half @ np.abs(self._view.rotation.T @ normal)
        return self.middle @ normal + extent + self.rounding * np.abs(normal).sum()

    def nearest(self, view: View) -> np.ndarray:
        """Lowest depth (n,) of each box [m], by the view's definition of depth."""
        if view.along_ray:
            return np.maximum(np.linalg.norm(self.middle, axis=1) - self._radius, 0.0)
        return -self.support(np.array([0.0, 0.0, -1.0]))

    def furthest(self, view: View) -> np.ndarray:
        """Highest depth (n,) of each box [m]."""
        if view.along_ray:
            return np.linalg.norm(self.middle, axis=1) + self._radius
        return self.support(np.array([0.0, 0.0, 1.0]))

    def distance_from_vertical_axis(self) -> np.ndarray:
        """Distance (n,) of each box from the vertical axis [m], near which panoramas are stretched."""
        return np.maximum(np.hypot(self.middle[:, 0], self.middle[:, 2]) - self._radius, 0.0)

    @property
    def _radius(self) -> np.ndarray:
        return np.linalg.norm(self._half, axis=1) + self.rounding

    def within_angle(
        self, angle: float, slope: float = 0.0, displacement: np.ndarray | None = None
    ) -> np.ndarray:
        """Mask (n,) of boxes that may have points within an angle [rad] of the optical axis, if points are
        displaced by `slope` times their distance to the camera, and by `displacement` (n,) metres."""
        distance = np.linalg.norm(self.middle, axis=1)
        with np.errstate(over="ignore"):  # infinite for a box around the camera
            angular_radius = np.arcsin(np.minimum(self._radius / np.maximum(distance, 1e-300), 1.0))
        off_axis = np.arctan2(np.hypot(self.middle[:, 0], self.middle[:, 1]), self.middle[:, 2])
        if displacement is not None:
            with np.errstate(over="ignore"):
                shift = slope + displacement / np.maximum(distance - self._radius, 1e-300)
            angular_radius = np.where(shift < 1, angular_radius + np.arcsin(np.minimum(shift, 1.0)), np.inf)
        return (distance <= self._radius) | (off_axis - angular_radius <= angle)


def _pinhole_sides(view: View, margin: float) -> list[tuple[np.ndarray, float]]:
    """Half spaces normal . p + offset >= 0 of the frustum's sides, widened by `margin` samples."""
    sides = []
    rows = (0, view.height) if view.sample_rows is None else view.sample_rows
    grid = ((0, view.focal_x, view.center_x, (0, view.width)), (1, view.focal_y, view.center_y, rows))
    for axis, focal, center, (first, end) in grid:
        for sign, border in ((1.0, first - margin), (-1.0, end + margin)):
            # sign (focal x / z + center - side) >= 0, times z for perspective
            normal = np.zeros(3)
            normal[axis] = sign * focal
            if view.parallel:
                sides.append((normal, sign * (center - border)))
                continue
            normal[2] = sign * (center - border)
            sides.append((normal, 0.0))
    return sides


def _max_ray_rotation(view: View) -> float:
    """Largest angle [rad] between neighbouring rays of a fisheye or panorama; may be infinite."""
    lens = view.lens
    if not isinstance(lens, Fisheye):
        return 1.0 / min(view.focal_x, view.focal_y)
    angles = np.linspace(1e-6, lens.max_angle, 4096)
    slopes = lens.image_radius(angles + 1e-6) - lens.image_radius(angles - 1e-6)
    min_slope = min(float(slopes.min()) / 2e-6, float((lens.image_radius(angles) / np.sin(angles)).min()))
    # 5 % margin, as angles are sampled
    return math.inf if min_slope < 0.05 else 1.05 / (min_slope * min(view.focal_x, view.focal_y))


@lru_cache(maxsize=8)
def _max_ray_angle(raster: RayRaster) -> float:
    """Largest angle [rad] between a sample's ray and the optical axis."""
    rays = raster.rays.astype(np.float64)
    return float(np.nanmax(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2])))


@lru_cache(maxsize=8)
def _slopes(raster: RayRaster) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum (x / z, y / z) of the samples' rays, (2,) each."""
    rays = raster.rays.astype(np.float64)
    slopes = rays[..., :2] / rays[..., 2:]
    return np.nanmin(slopes, axis=(0, 1)), np.nanmax(slopes, axis=(0, 1))


def projected_sizes(view: View, boxes: BoundingBoxes, edges: np.ndarray) -> np.ndarray:
    """Upper bound (n,) on the projected size [samples] of lengths (n,) [m] anywhere in each box, at all poses
    of the shutter and moving groups; infinite where a box contains the camera."""
    if view.sub_frames:
        return np.max(
            [projected_sizes(sub_frame.view, boxes, edges) for sub_frame in view.sub_frames], axis=0
        )
    max_sizes = np.zeros(len(edges))
    for pose_view in (view, *(group_view for _, group_view in view.groups)):
        focal = max(pose_view.focal_x, pose_view.focal_y)
        if isinstance(pose_view.lens, RayTable):
            focal = 1 / pose_view.lens.divergence  # samples per radian
        if pose_view.parallel:
            max_sizes = np.maximum(max_sizes, edges * focal)
            continue
        centers = CameraBoxes(pose_view, *boxes(0.0))
        panorama = pose_view.raster is not None and isinstance(pose_view.raster.lens, Equirectangular)
        nearest = centers.distance_from_vertical_axis() if panorama else centers.nearest(pose_view)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            size = np.where(nearest > 0, edges * focal / np.maximum(nearest, 1e-300), np.inf)
        max_sizes = np.maximum(max_sizes, np.where(edges > 0, size, 0.0))
    return max_sizes
