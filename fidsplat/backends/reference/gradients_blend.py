"""Samples as functions of placed splats, with the frame's decisions held constant; and their derivatives.

The intersection of a ray and a splat's plane is computed from the plane's normal, not from the affine forms
of the set-up as on devices, so that a comparison finds errors in either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.reference.blend import INVERSE_DEPTH, SPREAD_NEAR, inverse_depth, transmittance
from fidsplat.backends.reference.coverage import MIN_ALPHA
from fidsplat.backends.reference.fragments import HALF_RHO_OF_RANGE, fragments_of
from fidsplat.backends.reference.gradients_scene import Placed
from fidsplat.backends.reference.optics import rays_of
from fidsplat.backends.reference.setup import Setup
from fidsplat.backends.view import View


@dataclass
class Decisions:
    """Discrete decisions of the forward pass at k samples for m splats; bool arrays (k, m) unless stated."""

    order: np.ndarray
    """(m,) int: the cloud's splats, nearest first"""
    contributes: np.ndarray
    """above the cut-off, and blended before the stop"""
    by_disc: np.ndarray
    """the low-pass disc has the larger weight"""
    clamped: np.ndarray
    """clamped to the maximum alpha"""
    missed: np.ndarray
    """the ray does not meet the plane beyond `near`, so the depth is that of the centre"""
    mirrored: np.ndarray
    """the depth is mirrored at a circle"""
    wide: np.ndarray
    """mirrored at the disc's circle, not at the circle where the splat is 1/255 of its opacity"""
    covered: np.ndarray
    """(k,): the coverage suffices for depths and normals"""


def decide(s: Setup, view: View, x: np.ndarray, y: np.ndarray) -> Decisions:
    """The decisions of the forward pass at samples (k,) at grid positions x, y."""
    f = fragments_of(s, view, x, y)
    _, live, final = transmittance(f.alpha, view.stop, s.exclusive)
    q = f.n_u**2 + f.n_v**2
    inside = (q <= 2 * s.half_r2 * f.d**2) & (f.d > 0) & (f.d * view.near <= f.dz)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(inside, q / (2 * f.d**2), np.inf)
    disc = np.where(f.offset <= s.half_r2, f.offset, np.inf) if s.screen else np.full_like(plane, np.inf)
    return Decisions(
        order=s.order,
        contributes=live & (f.alpha > 0),
        by_disc=disc < plane,
        clamped=s.log_opacity - np.minimum(plane, disc) > np.log(view.ceiling),
        missed=(f.d <= 0) | (f.d * view.near > f.dz),
        mirrored=s.screen & (q > 2 * np.maximum(f.offset, HALF_RHO_OF_RANGE) * f.d**2),
        wide=f.offset > HALF_RHO_OF_RANGE,
        covered=1 - final >= MIN_ALPHA,
    )


@dataclass
class Samples:
    """Sample buffers of k samples; also used for the derivatives of a loss with respect to each of them."""

    rgb: np.ndarray
    """(k, 3)"""
    t: np.ndarray
    """transmittance"""
    depth: np.ndarray
    """sum of weights times depths"""
    weight: np.ndarray
    """sum of weights"""
    normal: np.ndarray
    """(k, 3) sum of weights times normals"""
    inverse: np.ndarray
    """sum of weights times inverse depths (`inverse_depth`)"""
    squares: np.ndarray
    """sum of weights times their squares"""


class Blend:
    """Differentiable blending of m placed splats at k samples under frozen decisions."""

    def __init__(self, placed: Placed, view: View, made: Decisions, x: np.ndarray, y: np.ndarray) -> None:
        self._placed, self._view, self._made = placed, view, made
        order = made.order
        self._unit_a, self._unit_b, self._p = placed.unit_a[order], placed.unit_b[order], placed.p[order]
        self._su, self._sv = placed.scales[order].T
        self._rgb, log_opacity = placed.rgb[order], placed.log_opacity[order]
        self._rays = rays_of(view, x, y)[0][:, None, :]
        self._normal = np.cross(self._unit_a, self._unit_b)
        height = (self._normal * self._p).sum(1)
        self._towards = np.where(height > 0, -1.0, 1.0)[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            self._slant = (self._rays * self._normal).sum(2)
            self._z_plane = height / self._slant
            self._off = self._z_plane[..., None] * self._rays - self._p
            self._u = (self._off * self._unit_a).sum(2) / self._su
            self._v = (self._off * self._unit_b).sum(2) / self._sv
            pz = self._p[:, 2]
            self._disc_x = x[:, None] - (view.focal_x * self._p[:, 0] / pz + view.center_x)
            self._disc_y = y[:, None] - (view.focal_y * self._p[:, 1] / pz + view.center_y)
            disc, plane = self._disc_x**2 + self._disc_y**2, (self._u**2 + self._v**2) / 2
            half_rho = np.where(made.by_disc, disc, plane)
            # share of the way from the centre's depth to the depth on the plane
            circle = np.where(made.wide, disc, HALF_RHO_OF_RANGE)
            self._share = np.where(made.mirrored, circle / plane, 1.0)
            self._plane = plane
            z = pz + self._share * (self._z_plane - pz)
            opacity = np.where(made.clamped, view.ceiling, np.exp(log_opacity - half_rho))
        self._z = np.where(made.contributes, np.where(made.missed, pz, z), 0.0)
        self._inverse = np.where(made.contributes, inverse_depth(self._z), 0.0)
        self._alpha = np.where(made.contributes, opacity, 0.0)
        after = np.cumprod(1 - self._alpha, axis=1)
        self._before = np.concatenate([np.ones((len(x), 1)), after], axis=1)
        self._weight = self._before[:, :-1] * self._alpha

    @property
    def samples(self) -> Samples:
        """The sample buffers."""
        return Samples(
            self._weight @ self._rgb,
            self._before[:, -1],
            (self._weight * self._z).sum(1),
            self._weight.sum(1),
            self._weight @ (self._normal * self._towards),
            (self._weight * self._inverse).sum(1),
            (self._weight * self._inverse**2).sum(1),
        )

    def backward(self, by: Samples) -> Placed:
        """Derivatives of a loss with respect to the placed splats, from those with respect to the samples."""
        made, view = self._made, self._view
        facing = self._normal * self._towards
        by_inverse = by.inverse[:, None] + 2 * by.squares[:, None] * self._inverse
        by_inverse = np.where(self._z > SPREAD_NEAR, by_inverse, 0.0)
        by_z = self._weight * (by.depth[:, None] - by_inverse * self._inverse**2 / INVERSE_DEPTH)
        by_alpha = np.where(made.contributes, self._by_opacity(by, facing), 0.0)
        by_log = np.where(made.clamped, 0.0, by_alpha * self._alpha)

        met = made.contributes & ~made.missed
        on_plane, mirrored = made.contributes & ~made.by_disc, met & made.mirrored
        share = np.where(met, self._share, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            by_share = np.where(mirrored, by_z * (self._z_plane - self._p[:, 2]), 0.0)
            by_plane = np.where(
                mirrored, -by_share * share / self._plane, 0.0
            )  # with respect to rho / 2 on the plane
            by_plane -= np.where(on_plane, by_log, 0.0)
            by_u = np.where(on_plane | met, by_plane * self._u / self._su, 0.0)
            by_v = np.where(on_plane | met, by_plane * self._v / self._sv, 0.0)
            by_disc = np.where(made.contributes & made.by_disc, by_log, 0.0)
            by_disc -= np.where(mirrored & made.wide, by_share / self._plane, 0.0)
            off = np.where((on_plane | met)[..., None], self._off, 0.0)
            by_off = by_u[..., None] * self._unit_a + by_v[..., None] * self._unit_b
            by_plane_z = (by_off * self._rays).sum(2) + by_z * share
            by_plane_z = np.where(on_plane | met, by_plane_z / self._slant, 0.0)
        by_normal = -(by_plane_z[..., None] * off).sum(0) + self._towards * (self._weight.T @ by.normal)
        by_a = np.einsum("kn,knc->nc", by_u, off) + np.cross(self._unit_b, by_normal)
        by_b = np.einsum("kn,knc->nc", by_v, off) + np.cross(by_normal, self._unit_a)
        by_p = by_plane_z.sum(0)[:, None] * self._normal - by_off.sum(0)

        # the low-pass disc around the projected centre
        by_x = 2 * np.where(by_disc != 0, by_disc * self._disc_x, 0.0).sum(0)
        by_y = 2 * np.where(by_disc != 0, by_disc * self._disc_y, 0.0).sum(0)
        x, y, z = self._p.T
        by_p += np.stack(
            [
                by_x * view.focal_x / z,
                by_y * view.focal_y / z,
                -(by_x * view.focal_x * x + by_y * view.focal_y * y) / z**2,
            ],
            1,
        )
        by_p[:, 2] += (by_z * (1 - share)).sum(0)

        out, order = Placed.zeros(len(self._placed.p)), made.order
        out.unit_a[order], out.unit_b[order], out.p[order] = by_a, by_b, by_p
        with np.errstate(invalid="ignore"):
            by_su = -np.where(on_plane | met, by_u * self._u, 0.0).sum(0)
            by_sv = -np.where(on_plane | met, by_v * self._v, 0.0).sum(0)
        out.scales[order] = np.stack([by_su, by_sv], 1)
        out.log_opacity[order] = by_log.sum(0)
        out.rgb[order] = self._weight.T @ by.rgb
        return out

    def _by_opacity(self, by: Samples, facing: np.ndarray) -> np.ndarray:
        """Derivatives (k, m) with respect to the fragments' opacities: the value of a fragment's own colour
        minus that of the colour behind it; from back to front, without a division by the transmittance."""
        worth = by.rgb @ self._rgb.T + by.normal @ facing.T + by.depth[:, None] * self._z
        worth = worth + by.weight[:, None] + by.inverse[:, None] * self._inverse
        worth = worth + by.squares[:, None] * self._inverse**2
        hidden, slopes = by.t.copy(), np.zeros_like(worth)
        for k in range(worth.shape[1] - 1, -1, -1):
            gain = worth[:, k] - hidden
            slopes[:, k] = self._before[:, k] * gain
            hidden = hidden + self._alpha[:, k] * gain
        return slopes
