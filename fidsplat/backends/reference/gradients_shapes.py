"""Weights and depths of splats along rays, with their derivatives: disks, and 3D Gaussians exact and by EWA.

The formulas differ from the formulas of projection.py and devices, so that a comparison finds mistakes in
either: ray-plane intersection, maximum of a Gaussian along a ray, inverse of a projected covariance.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from fidsplat.backends.reference.ellipsoids import EWA_SPREAD
from fidsplat.backends.reference.gradients_scene import CameraSplats
from fidsplat.backends.reference.optics import rays_of
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet


class Shapes(Protocol):
    """n splats of one primitive along the rays of k samples."""

    half_rho: np.ndarray
    """(k, n) half the squared distance, in standard deviations"""
    z: np.ndarray
    """(k, n) depths [m]"""
    facing: np.ndarray
    """(n, 3) unit normals towards the camera"""
    opacity_term: np.ndarray
    """(n,) term that is added to the logarithm of the opacity"""

    def backward(
        self,
        out: CameraSplats,
        grad_half_rho: np.ndarray,
        grad_z: np.ndarray,
        used: np.ndarray,
        grad_facing: np.ndarray,
        grad_opacity_term: np.ndarray,
    ) -> None:
        """Add derivatives of a loss with respect to the splats to `out`, from derivatives with respect to the
        attributes. used: (k, n) where half_rho or z counts; elsewhere they may be infinite."""
        ...


def shapes_of(
    splats: CameraSplats, view: View, features: FeatureSet, x: np.ndarray, y: np.ndarray
) -> list[tuple[np.ndarray, Shapes]]:
    """Indices of the splats of each primitive, and their shapes."""
    thick = splats.scales[:, 2] > 0
    flat, solid = np.flatnonzero(~thick), np.flatnonzero(thick)
    rays = rays_of(view, x, y)[0][:, None, :]
    shapes: list[tuple[np.ndarray, Shapes]] = [(flat, _Disks(splats.select(flat), rays, view))]
    if len(solid) and "ellipsoid_exact" in features.effects:
        shapes.append((solid, _Ellipsoids(splats.select(solid), rays, view)))
    elif len(solid):
        antialiased = "ellipsoid_ewa_antialiased" in features.effects
        shapes.append((solid, _Projected(splats.select(solid), view, antialiased, x, y)))
    return shapes


def _intrinsics_gradients(grad_rays: np.ndarray, rays: np.ndarray, view: View) -> np.ndarray:
    """Derivatives (n, 4) with respect to fx, fy, cx, cy, from derivatives (k, n, 3) with respect to rays."""
    across = -grad_rays[..., :2] / (view.focal_x, view.focal_y)
    return np.concatenate([(across * rays[..., :2]).sum(0), across.sum(0)], axis=1)


class _Disks:
    def __init__(self, splats: CameraSplats, rays: np.ndarray, view: View) -> None:
        self._splats, self._rays, self._view = splats, rays, view
        self._su, self._sv = splats.scales[:, :2].T
        self._normal = np.cross(splats.unit_a, splats.unit_b)
        height = (self._normal * splats.p).sum(1)
        self._towards = np.where(height > 0, -1.0, 1.0)[:, None]
        self.facing, self.opacity_term = self._normal * self._towards, np.zeros(len(splats.p))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            self._slant = (rays * self._normal).sum(2)
            self.z = height / self._slant
            self._off = self.z[..., None] * rays - splats.p
            self._u = (self._off * splats.unit_a).sum(2) / self._su
            self._v = (self._off * splats.unit_b).sum(2) / self._sv
            self.half_rho = (self._u**2 + self._v**2) / 2

    def backward(self, out, grad_half_rho, grad_z, used, grad_facing, grad_opacity_term) -> None:
        unit_a, unit_b = self._splats.unit_a, self._splats.unit_b
        with np.errstate(invalid="ignore", divide="ignore"):
            grad_u = np.where(used, grad_half_rho * self._u / self._su, 0.0)
            grad_v = np.where(used, grad_half_rho * self._v / self._sv, 0.0)
            off = np.where(used[..., None], self._off, 0.0)
            grad_off = grad_u[..., None] * unit_a + grad_v[..., None] * unit_b
            grad_plane_z = np.where(used, ((grad_off * self._rays).sum(2) + grad_z) / self._slant, 0.0)
            out.scales[:, 0] = -np.where(used, grad_u * self._u, 0.0).sum(0)
            out.scales[:, 1] = -np.where(used, grad_v * self._v, 0.0).sum(0)
        grad_normal = -(grad_plane_z[..., None] * off).sum(0) + self._towards * grad_facing
        out.unit_a[:] = np.einsum("kn,knc->nc", grad_u, off) + np.cross(unit_b, grad_normal)
        out.unit_b[:] = np.einsum("kn,knc->nc", grad_v, off) + np.cross(grad_normal, unit_a)
        out.p[:] = grad_plane_z.sum(0)[:, None] * self._normal - grad_off.sum(0)
        grad_rays = grad_off - grad_plane_z[..., None] * self._normal
        grad_rays *= np.where(used, self.z, 0.0)[..., None]
        out.intrinsics[:] = _intrinsics_gradients(grad_rays, self._rays, self._view)


class _Solid:
    """3D Gaussians: their axes, and the normal along the inverse covariance times the ray to the centre."""

    def __init__(self, splats: CameraSplats) -> None:
        self._p, self._scales = splats.p, splats.scales
        third = np.cross(splats.unit_a, splats.unit_b)
        self._axes = np.stack([splats.unit_a, splats.unit_b, third], axis=1)
        """(n, 3, 3) unit axes, one per row"""
        # relative to the shortest axis, which does not change the direction
        self._shares = (splats.scales.min(axis=1)[:, None] / splats.scales) ** 2
        self._along = np.einsum("nkc,nc->nk", self._axes, splats.p)
        normal = np.einsum("nk,nkc->nc", self._along * self._shares, self._axes)
        self._length = np.linalg.norm(normal, axis=1, keepdims=True)
        self.facing = -normal / self._length

    def _finish(self, out: CameraSplats, grad_axes: np.ndarray, grad_facing: np.ndarray) -> None:
        """Add the derivatives with respect to the normals and to all axes (n, 3, 3)."""
        across = grad_facing - self.facing * (self.facing * grad_facing).sum(1, keepdims=True)
        grad_normal = -across / self._length
        grad_share = np.einsum("nkc,nc->nk", self._axes, grad_normal)
        grad_along = grad_share * self._shares
        grad_axes = grad_axes + (self._along * self._shares)[..., None] * grad_normal[:, None]
        grad_axes += grad_along[..., None] * self._p[:, None]
        out.p += np.einsum("nk,nkc->nc", grad_along, self._axes)
        # the normal is normalised: the shortest scale, a factor of all shares, has no derivative
        out.scales += -2 * grad_along * self._along / self._scales
        a, b, c = grad_axes.transpose(1, 0, 2)
        out.unit_a += a + np.cross(self._axes[:, 1], c)
        out.unit_b += b + np.cross(c, self._axes[:, 0])


class _Ellipsoids(_Solid):
    """3D Gaussians by their maximum along each ray: after whitening, at distance |y x r| / |r| from the ray r
    to the centre y."""

    def __init__(self, splats: CameraSplats, rays: np.ndarray, view: View) -> None:
        super().__init__(splats)
        self.opacity_term = np.zeros(len(splats.p))
        self._rays, self._view, scales = rays[:, 0], view, splats.scales
        self._y = self._along / scales
        self._r = np.einsum("nkc,sc->snk", self._axes, self._rays) / scales
        self._square = (self._r**2).sum(2)
        self._cross = np.cross(self._y, self._r)
        self.half_rho = (self._cross**2).sum(2) / (2 * self._square)
        self.z = (self._y * self._r).sum(2) / self._square

    def backward(self, out, grad_half_rho, grad_z, used, grad_facing, grad_opacity_term) -> None:
        grad_cross = (grad_half_rho / self._square)[..., None] * self._cross
        grad_dot = grad_z / self._square
        grad_square = -(grad_half_rho * self.half_rho + grad_z * self.z) / self._square
        grad_r = (
            2 * grad_square[..., None] * self._r
            + grad_dot[..., None] * self._y
            + np.cross(grad_cross, self._y)
        )
        grad_y = (grad_dot[..., None] * self._r + np.cross(self._r, grad_cross)).sum(0)
        scales = self._scales
        grad_axes = np.einsum("snk,sc->nkc", grad_r, self._rays) + grad_y[..., None] * self._p[:, None]
        out.p += np.einsum("nk,nkc->nc", grad_y / scales, self._axes)
        out.scales -= (grad_y * self._y + (grad_r * self._r).sum(0)) / scales
        grad_rays = np.einsum("snk,nkc->snc", grad_r / scales, self._axes)
        out.intrinsics[:] = _intrinsics_gradients(grad_rays, self._rays[:, None], self._view)
        self._finish(out, grad_axes / scales[..., None], grad_facing)


class _Projected(_Solid):
    """3D Gaussians by EWA: image covariance by the Jacobian at the centre, plus 0.3 square pixels."""

    def __init__(
        self, splats: CameraSplats, view: View, antialiased: bool, x: np.ndarray, y: np.ndarray
    ) -> None:
        super().__init__(splats)
        self._antialiased, self._focal = antialiased, np.array([view.focal_x, view.focal_y])
        self._per = self._focal / splats.p[:, 2:]
        left, right, up, down = view.ewa_clamp
        slopes = splats.p[:, :2] / splats.p[:, 2:]
        self._slopes = np.clip(slopes, (-left, -up), (right, down))
        self._inside = self._slopes == slopes
        scaled = self._axes * splats.scales[..., None]
        self._flat = scaled[..., :2] - scaled[..., 2:] * self._slopes[:, None]
        self._images = self._flat * self._per[:, None]
        """(n, 3, 2) projections of the scaled axes [samples]"""
        across, down = self._images[..., 0], self._images[..., 1]
        self._crossed = np.cross(across, down)
        self._own = (self._crossed**2).sum(1)
        covariance = np.einsum("nki,nkj->nij", self._images, self._images) + EWA_SPREAD * np.eye(2)
        grown = self._own + EWA_SPREAD * (np.einsum("nii->n", covariance) - EWA_SPREAD)
        xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        self._conic = np.array([[yy, -xy], [-xy, xx]]).transpose(2, 0, 1) / grown[:, None, None]
        self._away = np.stack([x[:, None] - splats.center[:, 0], y[:, None] - splats.center[:, 1]], 2)
        self._pull = np.einsum("nij,knj->kni", self._conic, self._away)
        self.half_rho = (self._pull * self._away).sum(2) / 2
        self.z = np.broadcast_to(splats.p[:, 2], self.half_rho.shape)
        with np.errstate(divide="ignore"):
            self.opacity_term = 0.5 * np.log(self._own / grown) if antialiased else np.zeros(len(grown))

    def backward(self, out, grad_half_rho, grad_z, used, grad_facing, grad_opacity_term) -> None:
        pz, per, scales = self._p[:, 2:], self._per, self._scales
        out.center -= np.einsum("kn,kni->ni", grad_half_rho, self._pull)
        # with respect to the covariance C: half_rho has -(C^-1 d)(C^-1 d)^T / 2
        grad_covariance = -0.5 * np.einsum("kn,kni,knj->nij", grad_half_rho, self._pull, self._pull)
        grad_images = np.zeros_like(self._images)
        if self._antialiased:
            grad_covariance -= 0.5 * grad_opacity_term[:, None, None] * self._conic
            grad_crossed = (grad_opacity_term / self._own)[:, None] * self._crossed
            grad_images[..., 0] += np.cross(self._images[..., 1], grad_crossed)
            grad_images[..., 1] += np.cross(grad_crossed, self._images[..., 0])
        grad_images += 2 * np.einsum("nij,nkj->nki", grad_covariance, self._images)
        grad_per = (grad_images * self._flat).sum(1)
        grad_flat = grad_images * per[:, None]
        grad_scaled = np.concatenate(
            [grad_flat, -(grad_flat * self._slopes[:, None]).sum(2, keepdims=True)], 2
        )
        scaled_z = self._axes[:, :, 2] * scales
        grad_slopes = -np.einsum("nki,nk->ni", grad_flat, scaled_z)
        grad_limits = -grad_slopes * ~self._inside / self._focal
        out.intrinsics[:] = np.concatenate([grad_per / pz + grad_limits * self._slopes, grad_limits], axis=1)
        grad_slopes *= self._inside
        out.p[:, :2] += grad_slopes / pz
        out.p[:, 2] += grad_z.sum(0) - ((grad_slopes * self._slopes + grad_per * per) / pz).sum(1)
        out.scales += (grad_scaled * self._axes).sum(2)
        self._finish(out, grad_scaled * scales[..., None], grad_facing)
