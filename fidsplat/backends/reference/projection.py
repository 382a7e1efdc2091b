"""Per-splat projection of the reference renderer: culling, camera transform, forms, colours, depth order."""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from fidsplat.backends.cloud_arrays import group_index
from fidsplat.backends.reference import ellipsoids, optics
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.splats.cloud import SplatCloud, sh_basis
from fidsplat.splats.rotations import quaternion_to_matrix


class ProjectedSplats:
    """Camera-space splats that are not culled; float64 arrays (n, ...) in depth order."""

    def __init__(self, cloud: SplatCloud, view: View, features: FeatureSet) -> None:
        rotations = quaternion_to_matrix(cloud.quats)
        tangent_u, tangent_v = (np.ascontiguousarray(rotations[:, :, axis]) for axis in (0, 1))
        mean, scale = cloud.means.astype(np.float64), cloud.scales.astype(np.float64)
        scale = np.maximum(scale, np.float32(1e-20))  # MIN_SCALE of the kernels
        unit_a, unit_b, p, outward = _posed(view, tangent_u, tangent_v, mean)
        for label, group_view in view.groups:
            in_group = (cloud.labels == label)[:, None]
            moved = _posed(group_view, tangent_u, tangent_v, mean)
            unit_a, unit_b, p, outward = (
                np.where(in_group, moved_value, value)
                for moved_value, value in zip(moved, (unit_a, unit_b, p, outward), strict=True)
            )
        shape = _shapes(unit_a, unit_b, scale, p, cloud, view, features)
        a, b, area = shape.a, shape.b, shape.area
        depth = np.linalg.norm(p, axis=1) if view.along_ray else p[:, 2]
        self.key = depth.astype(np.float32)
        with np.errstate(divide="ignore"):
            log_opacity = np.log(cloud.opacities.astype(np.float64)) + shape.opacity_term
        box = np.zeros(len(cloud), bool) if cloud.boxes is None else cloud.boxes
        thick = np.zeros(len(cloud), bool) if cloud.thickness is None else cloud.thickness > 0
        unfiltered = box | (thick & ("ellipsoid_exact" not in features.effects))
        if "lowpass_pixel" in features.effects:
            filtered = ~unfiltered & (depth >= view.near)
            a, b, area_factor = _filtered(a, b, p, view, filtered)
            area = area * area_factor
            with np.errstate(divide="ignore"):
                log_opacity = log_opacity - np.log(area_factor)
        half_r2 = log_opacity - view.log_alpha_cutoff
        if view.along_ray:
            long_a, long_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
            reach, box_reach = np.maximum(long_a, long_b), long_a + long_b
            ellipsoid_radius = np.hypot(np.hypot(long_a, long_b), np.linalg.norm(shape.third, axis=1))
            reach = np.where(thick, ellipsoid_radius, reach)
        else:
            reach, box_reach = np.hypot(a[:, 2], b[:, 2]), np.abs(a[:, 2]) + np.abs(b[:, 2])
            reach = np.hypot(reach, shape.third[:, 2])
        radius = np.sqrt(np.maximum(2 * half_r2, 0))
        # the disc of the low-pass applies at any cut-off
        z_extent = np.maximum(radius, _RANGE_RADIUS if "lowpass_screen" in features.effects else 0.0) * reach
        z_extent = np.where(box, box_reach, z_extent)
        reach = np.where(box, box_reach, radius * reach)
        visible = (half_r2 > 0) & (depth + reach >= view.near) & (depth - reach <= view.far)
        self.by_depth = not {"order_pixel", "order_coplanar_pixel"}.isdisjoint(features.effects)
        """whether fragments are composited by their own depth"""
        layered = not {"order_coplanar", "order_coplanar_pixel"}.isdisjoint(features.effects)
        groups = group_index(cloud) if layered else np.full(len(cloud), -1, np.int32)
        # depths must not depend on the cut-off
        radius = np.where(groups >= 0, _PLANE_RADIUS, np.where(box, 1.0, _RANGE_RADIUS))
        with np.errstate(divide="ignore", invalid="ignore"):
            z_extent_of_order = reach * radius / np.where(box, 1.0, np.sqrt(2 * half_r2))
        z_extent = np.where((groups >= 0) | self.by_depth, z_extent_of_order, z_extent)
        z_low, z_high = depth - z_extent, depth + z_extent
        behind = depth < view.near  # fragments are beyond `near`
        z_low, z_high = (
            np.where(behind, view.near, z_low),
            np.where(behind, np.maximum(view.near, z_high), z_high),
        )
        if self.by_depth:
            self.key = z_low.astype(np.float32)
        self.key[groups >= 0] = -np.inf
        visible &= np.isfinite(shape.inverse_m2)  # infinite if the camera is at the splat's centre
        order = np.flatnonzero(visible)
        order = order[np.lexsort((groups[order], self.key[order]))]
        self.order = order

        normal, self.normal_error = shape.normal[order], shape.normal_error[order]
        self.inverse_m2 = shape.inverse_m2[order]
        """1 / |W p|^2 (ellipsoids.py); above 0 for 3D Gaussians with `ellipsoid_exact`"""
        a, b, p, area = a[order], b[order], p[order], area[order]
        self.log_opacity, self.half_r2 = log_opacity[order], half_r2[order]
        self.z_low, self.z_high = z_low[order], z_high[order]
        """range of the fragments' depths"""
        self.labels = cloud.labels[order]
        self.pz = depth[order]
        # the sign of the camera's distance from the plane decides the visible side; 0: edge-on
        plane_distance = normal[:, 2] if view.parallel else np.einsum("ij,ij->i", normal, p)
        edge_on = np.abs(plane_distance) <= 1e-13 * (1.0 if view.parallel else np.linalg.norm(p, axis=1))
        sign = np.where(edge_on, 0.0, np.sign(plane_distance))
        self.forms, depth_forms, size = optics.forms_of(view, a, b, p)
        """(3, n, 3): coefficients of a sample's coordinates in n_u, n_v, D"""
        self.forms[:, :, 2] *= sign
        self.depth_forms = depth_forms * sign if view.parallel else None
        """(3, n): coefficients in D times the depth, for parallel rays; otherwise it is `z_numerator` (n,)"""
        self.z_numerator = size * area * np.abs(plane_distance * sign)

        self.box = box[order]

        in_front = self.pz >= view.near
        image_x, image_y = optics.centers_of(view, p, in_front)
        in_front &= np.isfinite(image_x)
        self.has_lowpass = in_front & ~unfiltered[order]  # boxes and EWA Gaussians have no low-pass disc
        self.center_x, self.center_y = (np.where(self.has_lowpass, at, np.inf) for at in (image_x, image_y))
        # devices store the affine forms relative to the pixel nearest to the centre's image; there is none if
        # the centre is behind the camera
        self.anchor_x = _anchor(image_x, in_front, view.width)
        self.anchor_y = _anchor(image_y, in_front, view.height)
        self.anchors = optics.anchors_of(view, self.anchor_x, self.anchor_y)
        self.round = optics.ROUND if view.raster is None else optics.ROUND_OF_RAYS
        """rounding error of a form in float32, relative to its terms"""
        self.colors = _colors(cloud, order, outward[order])
        self.normal = shape.surface[order] * np.where(plane_distance > 0, -1.0, 1.0)[:, None]
        self.has_screen_lowpass = "lowpass_screen" in features.effects
        self.exclusive = "stop_exclusive" in features.effects
        self.coplanar_groups = groups[order] if layered else None
        """dense index of the group whose layer a splat is part of, -1 for none, or None without layers"""
        self.coplanar = groups[order] >= 0

    def subset(self, mask: np.ndarray) -> ProjectedSplats:
        """The splats of a mask (n,) bool, in the same order."""
        if mask.all():
            return self
        part = copy(self)
        for name in _OF_SPLATS:
            setattr(part, name, getattr(self, name)[mask])
        for name in _OF_COORDINATES:
            setattr(part, name, getattr(self, name)[:, mask])
        if self.depth_forms is not None:
            part.depth_forms = self.depth_forms[:, mask]
        if self.coplanar_groups is not None:
            part.coplanar_groups = self.coplanar_groups[mask]
        return part


DEPTH_SHARE = 1 / 8
"""standard deviation of the low-pass filter `pixel` along the ray, per metre of depth"""
_RANGE_RADIUS = math.sqrt(2 * math.log(255))
"""radius in standard deviations of the disk that limits the depths of a splat's fragments"""
_PLANE_RADIUS = 64.0
"""the same for splats of a coplanar group, larger than any cut-off, so that culling a splat does not move the
layer"""
_OF_SPLATS = (
    *("order", "log_opacity", "half_r2", "z_low", "z_high", "labels", "pz", "z_numerator", "inverse_m2"),
    *(
        "normal_error",
        "box",
        "has_lowpass",
        "center_x",
        "center_y",
        "anchor_x",
        "anchor_y",
        "colors",
        "normal",
        "coplanar",
    ),
)
"""arrays (n, ...) of a ProjectedSplats"""
_OF_COORDINATES = ("forms", "anchors")
"""arrays (3, n, ...) of a ProjectedSplats"""


def _shapes(
    unit_a: np.ndarray,
    unit_b: np.ndarray,
    scale: np.ndarray,
    p: np.ndarray,
    cloud: SplatCloud,
    view: View,
    features: FeatureSet,
) -> ellipsoids.Axes:
    """Disks with the same images as the splats. unit_a, unit_b, p (n, 3) in the camera frame, scale (n,
    2)."""
    axes_of_all = ellipsoids.disks(unit_a, unit_b, scale)
    if cloud.thickness is None:
        return axes_of_all
    thick = cloud.thickness > 0
    third = np.maximum(cloud.thickness[thick].astype(np.float64), np.float32(1e-20))
    scales = np.column_stack([scale[thick], third])
    axes = np.stack([unit_a, unit_b, np.cross(unit_a, unit_b)], axis=1)[thick]
    if "ellipsoid_exact" in features.effects:
        thick_axes = ellipsoids.exact(axes, scales, p[thick], view)
    else:
        thick_axes = ellipsoids.ewa(
            axes, scales, p[thick], view, "ellipsoid_ewa_antialiased" in features.effects
        )
        # undefined otherwise
        thick_axes.opacity_term = np.where(p[thick, 2] >= view.near, thick_axes.opacity_term, -np.inf)
    for name, values in vars(thick_axes).items():
        getattr(axes_of_all, name)[thick] = values
    return axes_of_all


def _posed(
    view: View, tangent_u: np.ndarray, tangent_v: np.ndarray, mean: np.ndarray
) -> tuple[np.ndarray, ...]:
    """Unit tangents and centres in the camera frame, and centres minus the eye, (n, 3) each."""
    rotation = view.rotation.T
    return tangent_u @ rotation, tangent_v @ rotation, mean @ rotation + view.translation, mean - view.eye


def _filtered(
    a: np.ndarray, b: np.ndarray, p: np.ndarray, view: View, mask: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scaled tangents (n, 3) after the low-pass `pixel`, and the factor (n,) by which areas grow; unchanged
    if not `mask` (n,) or if the centre has no image.

    The filter of a sample is a Gaussian about its ray, with a standard deviation of half a sample across the
    ray and of `DEPTH_SHARE` of the depth along it (infinite for parallel rays). Its covariance in (u, v) is
    (G^T G)^-1, with G the derivative of these coordinates, in standard deviations, with respect to (u, v) at
    the centre.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        across, along = optics.derivatives_of(view, p) / 0.5, optics.along_of(view, p) / DEPTH_SHARE
        slopes = np.concatenate([across, along[:, None]], axis=1)
        mask = mask & np.isfinite(slopes).all((1, 2))
        g_u, g_v = (np.einsum("nij,nj->ni", slopes, t) for t in (a, b))
        m11, m12, m22 = (np.einsum("ni,ni->n", g, h) for g, h in ((g_u, g_u), (g_u, g_v), (g_v, g_v)))
        determinant = (np.cross(g_u, g_v) ** 2).sum(1)  # of G^T G, without cancellation
        c11, c12 = 1 + m22 / determinant, -m12 / determinant
        area_factor = np.sqrt(1 + (m11 + m22 + 1) / determinant)
        l11 = np.sqrt(c11)
        area_factor, wide_a = np.where(mask, area_factor, 1.0), l11[:, None] * a + (c12 / l11)[:, None] * b
        wide_b = (area_factor / l11)[:, None] * b
    # disks edge-on to parallel rays grow without limit and are culled
    mask = (mask & np.isfinite(area_factor))[:, None]
    return np.where(mask, wide_a, a), np.where(mask, wide_b, b), area_factor


def _anchor(center: np.ndarray, known: np.ndarray, size: int) -> np.ndarray:
    nearest = np.clip(np.floor(np.where(known, center, 0.0)) + 0.5, 0.5, size - 0.5)
    return np.where(known, nearest, -float(size))


def _colors(cloud: SplatCloud, order: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Colours (n, 3) of the splats in order."""
    if cloud.sh is None:
        return cloud.colors[order].astype(np.float64)  # type: ignore[index]
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    directions = rays / np.where(length > 0, length, 1)
    basis = sh_basis(cloud.sh_degree, directions)
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, cloud.sh[order].astype(np.float64)), 0)
