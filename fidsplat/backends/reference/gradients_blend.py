"""Samples as functions of splats in the camera frame, with thresholds and order held constant, and their
derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.reference.blend import (
    INVERSE_DEPTH,
    MIN_ALPHA,
    SPREAD_NEAR,
    inverse_depth,
    transmittance,
)
from fidsplat.backends.reference.fragments import HALF_RHO_OF_RANGE, ellipsoid_forms, fragments_of
from fidsplat.backends.reference.gradients_scene import CameraSplats
from fidsplat.backends.reference.gradients_shapes import shapes_of
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet


@dataclass
class Decisions:
    """Discrete decisions of the forward pass at k samples for m splats; bool arrays (k, m) unless stated."""

    order: np.ndarray
    """(m,) int: the cloud's splats, nearest first"""
    contributes: np.ndarray
    """whether alpha is above the cut-off and blended before the stop"""
    by_lowpass: np.ndarray
    """whether the low-pass disc has the larger weight"""
    clamped: np.ndarray
    """whether alpha is clamped to its maximum"""
    missed: np.ndarray
    """whether the ray does not meet the plane beyond `near`, so that the fragment has the depth of the
    centre"""
    mirrored: np.ndarray
    """whether the point on the plane is outside a circle around the centre: the fragment then has the depth
    of the point inverted in this circle (at radius R^2 / r instead of r)"""
    at_disc: np.ndarray
    """whether this circle is the low-pass disc at the sample, instead of the circle where alpha is 1/255 of
    the opacity"""
    covered: np.ndarray
    """(k,): whether a sample's accumulated alpha suffices for a depth and a normal"""


def decide(s: ProjectedSplats, view: View, x: np.ndarray, y: np.ndarray) -> Decisions:
    """The decisions of the forward pass at samples (k,) at grid positions x, y."""
    f = fragments_of(s, view, x, y)
    _, live, final = transmittance(f.alpha, view.transmittance_stop, s.exclusive)
    d, q = ellipsoid_forms(s.inverse_m2, f.d, f.n_u**2 + f.n_v**2)
    inside = (q <= 2 * s.half_r2 * d**2) & (d > 0) & (d * view.near <= f.dz)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(inside, q / (2 * d**2), np.inf)
    disc = np.where(s.has_screen_lowpass & (f.offset <= s.half_r2), f.offset, np.inf)
    return Decisions(
        order=s.order,
        contributes=live & (f.alpha > 0),
        by_lowpass=disc < plane,
        clamped=s.log_opacity - np.minimum(plane, disc) > np.log(view.opacity_ceiling),
        missed=(d <= 0) | (d * view.near > f.dz),
        mirrored=s.has_screen_lowpass & (q > 2 * np.maximum(f.offset, HALF_RHO_OF_RANGE) * d**2),
        at_disc=f.offset > HALF_RHO_OF_RANGE,
        covered=1 - final >= MIN_ALPHA,
    )


@dataclass
class Samples:
    """Sample buffers of k samples; also used for the derivatives of a loss with respect to each of them."""

    rgb: np.ndarray
    """(k, 3)"""
    t: np.ndarray
    depth: np.ndarray
    weight: np.ndarray
    normal: np.ndarray
    """(k, 3) sum of weights times normals"""
    inverse: np.ndarray
    """sum of weights times inverse depths (`inverse_depth`)"""
    squares: np.ndarray
    """sum of weights times squared inverse depths"""


class Blend:
    """Differentiable blending of m splats at k samples under frozen decisions."""

    def __init__(
        self,
        splats: CameraSplats,
        view: View,
        features: FeatureSet,
        decisions: Decisions,
        x: np.ndarray,
        y: np.ndarray,
    ) -> None:
        self._count, self._decisions = len(splats.p), decisions
        chosen = splats.select(decisions.order)
        self._rgb, log_opacity = chosen.rgb, chosen.log_opacity.copy()
        self._shapes = shapes_of(chosen, view, features, x, y)
        self._pz = chosen.p[:, 2]
        self._plane, self._z_plane = np.empty((2, len(x), len(self._pz)))
        self._facing = np.empty_like(chosen.p)
        for rows, shape in self._shapes:
            self._plane[:, rows], self._z_plane[:, rows] = shape.half_rho, shape.z
            self._facing[rows] = shape.facing
            log_opacity[rows] += shape.opacity_term
        self._disc_x, self._disc_y = (at[:, None] - c for at, c in zip((x, y), chosen.center.T, strict=True))
        plane, z_plane = self._plane, self._z_plane
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            disc = self._disc_x**2 + self._disc_y**2
            half_rho = np.where(decisions.by_lowpass, disc, plane)
            # interpolation factor from the centre's depth to the depth on the plane
            circle = np.where(decisions.at_disc, disc, HALF_RHO_OF_RANGE)
            self._depth_factor = np.where(decisions.mirrored, circle / plane, 1.0)
            z = self._pz + self._depth_factor * (z_plane - self._pz)
            alpha = np.where(decisions.clamped, view.opacity_ceiling, np.exp(log_opacity - half_rho))
        self._z = np.where(decisions.contributes, np.where(decisions.missed, self._pz, z), 0.0)
        self._inverse = np.where(decisions.contributes, inverse_depth(self._z), 0.0)
        self._alpha = np.where(decisions.contributes, alpha, 0.0)
        after = np.cumprod(1 - self._alpha, axis=1)
        self._before = np.concatenate([np.ones((len(x), 1)), after], axis=1)
        self._weight = self._before[:, :-1] * self._alpha

    @property
    def samples(self) -> Samples:
        return Samples(
            self._weight @ self._rgb,
            self._before[:, -1],
            (self._weight * self._z).sum(1),
            self._weight.sum(1),
            self._weight @ self._facing,
            (self._weight * self._inverse).sum(1),
            (self._weight * self._inverse**2).sum(1),
        )

    def backward(self, grads: Samples) -> CameraSplats:
        """Derivatives of a loss with respect to the splats, from derivatives with respect to the samples."""
        decisions = self._decisions
        grad_inverse = grads.inverse[:, None] + 2 * grads.squares[:, None] * self._inverse
        grad_inverse = np.where(self._z > SPREAD_NEAR, grad_inverse, 0.0)
        grad_z = self._weight * (grads.depth[:, None] - grad_inverse * self._inverse**2 / INVERSE_DEPTH)
        grad_alpha = np.where(decisions.contributes, self._alpha_gradients(grads), 0.0)
        grad_log = np.where(decisions.clamped, 0.0, grad_alpha * self._alpha)

        met = decisions.contributes & ~decisions.missed
        on_plane, mirrored = decisions.contributes & ~decisions.by_lowpass, met & decisions.mirrored
        depth_factor = np.where(met, self._depth_factor, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            grad_depth_factor = np.where(mirrored, grad_z * (self._z_plane - self._pz), 0.0)
            # derivative with respect to rho / 2 of the ray-plane intersection
            grad_plane = np.where(mirrored, -grad_depth_factor * depth_factor / self._plane, 0.0)
            grad_plane -= np.where(on_plane, grad_log, 0.0)
            grad_lowpass = np.where(decisions.contributes & decisions.by_lowpass, grad_log, 0.0)
            grad_lowpass -= np.where(mirrored & decisions.at_disc, grad_depth_factor / self._plane, 0.0)
        grad_facing, grad_log_opacity = self._weight.T @ grads.normal, grad_log.sum(0)
        splat_grads = CameraSplats.zeros(len(self._pz))
        for rows, shape in self._shapes:
            results = CameraSplats.zeros(len(rows))
            grad_half_rho, grad_depth = grad_plane[:, rows], grad_z[:, rows] * depth_factor[:, rows]
            used = (on_plane | met)[:, rows]
            shape.backward(
                results, grad_half_rho, grad_depth, used, grad_facing[rows], grad_log_opacity[rows]
            )
            for name, array in vars(results).items():
                getattr(splat_grads, name)[rows] = array
        for axis, distance in enumerate((self._disc_x, self._disc_y)):
            splat_grads.center[:, axis] += 2 * np.where(grad_lowpass != 0, grad_lowpass * distance, 0.0).sum(
                0
            )
        splat_grads.p[:, 2] += (grad_z * (1 - depth_factor)).sum(0)
        splat_grads.log_opacity, splat_grads.rgb = grad_log_opacity, self._weight.T @ grads.rgb
        out = CameraSplats.zeros(self._count)
        for name, array in vars(splat_grads).items():
            getattr(out, name)[decisions.order] = array
        return out

    def _alpha_gradients(self, grads: Samples) -> np.ndarray:
        """Derivatives (k, m) with respect to the fragments' opacities: the term of a fragment's own colour
        minus the term of the colour behind it, from back to front."""
        own_term = grads.rgb @ self._rgb.T + grads.normal @ self._facing.T + grads.depth[:, None] * self._z
        own_term = own_term + grads.weight[:, None] + grads.inverse[:, None] * self._inverse
        own_term = own_term + grads.squares[:, None] * self._inverse**2
        term_behind, alpha_grads = grads.t.copy(), np.zeros_like(own_term)
        for k in range(own_term.shape[1] - 1, -1, -1):
            difference = own_term[:, k] - term_behind
            alpha_grads[:, k] = self._before[:, k] * difference
            term_behind = term_behind + self._alpha[:, k] * difference
        return alpha_grads
