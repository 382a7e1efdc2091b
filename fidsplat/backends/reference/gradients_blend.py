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
from fidsplat.backends.reference.fragments import HALF_RHO_OF_RANGE, bulged, fragments_of
from fidsplat.backends.reference.gradients_scene import Placed
from fidsplat.backends.reference.gradients_shapes import shapes_of
from fidsplat.backends.reference.setup import Setup
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet


@dataclass
class Decisions:
    """Discrete decisions of the forward pass at k samples for m splats; bool arrays (k, m) unless stated."""

    order: np.ndarray
    """(m,) int: the cloud's splats, nearest first"""
    contributes: np.ndarray
    """whether alpha is above the cut-off and blended before the stop"""
    by_disc: np.ndarray
    """whether the low-pass disc has the larger weight"""
    clamped: np.ndarray
    """whether alpha is clamped to its maximum"""
    missed: np.ndarray
    """whether the ray does not meet the plane beyond `near`, so that the fragment has the depth of the
    centre"""
    mirrored: np.ndarray
    """whether the depth is mirrored at a circle"""
    wide: np.ndarray
    """whether it is mirrored at the disc's circle instead of the circle where the splat is 1/255 of its
    opacity"""
    covered: np.ndarray
    """(k,): whether the coverage suffices for depths and normals"""


def decide(s: Setup, view: View, x: np.ndarray, y: np.ndarray) -> Decisions:
    """The decisions of the forward pass at samples (k,) at grid positions x, y."""
    f = fragments_of(s, view, x, y)
    _, live, final = transmittance(f.alpha, view.stop, s.exclusive)
    d, q = bulged(s.inverse_m2, f.d, f.n_u**2 + f.n_v**2)
    inside = (q <= 2 * s.half_r2 * d**2) & (d > 0) & (d * view.near <= f.dz)
    with np.errstate(divide="ignore", invalid="ignore"):
        plane = np.where(inside, q / (2 * d**2), np.inf)
    disc = np.where(f.offset <= s.half_r2, f.offset, np.inf) if s.screen else np.full_like(plane, np.inf)
    return Decisions(
        order=s.order,
        contributes=live & (f.alpha > 0),
        by_disc=disc < plane,
        clamped=s.log_opacity - np.minimum(plane, disc) > np.log(view.ceiling),
        missed=(d <= 0) | (d * view.near > f.dz),
        mirrored=s.screen & (q > 2 * np.maximum(f.offset, HALF_RHO_OF_RANGE) * d**2),
        wide=f.offset > HALF_RHO_OF_RANGE,
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
    """Differentiable blending of m placed splats at k samples under frozen decisions."""

    def __init__(
        self, placed: Placed, view: View, features: FeatureSet, made: Decisions, x: np.ndarray, y: np.ndarray
    ) -> None:
        self._count, self._made = len(placed.p), made
        chosen = placed.select(made.order)
        self._rgb, log_opacity = chosen.rgb, chosen.log_opacity.copy()
        self._shapes = shapes_of(chosen, view, features, x, y)
        self._pz = chosen.p[:, 2]
        self._plane, self._z_plane = np.empty((2, len(x), len(self._pz)))
        self._facing = np.empty_like(chosen.p)
        for rows, shape in self._shapes:
            self._plane[:, rows], self._z_plane[:, rows] = shape.half_rho, shape.z
            self._facing[rows] = shape.facing
            log_opacity[rows] += shape.faint
        self._disc_x, self._disc_y = (at[:, None] - c for at, c in zip((x, y), chosen.center.T, strict=True))
        plane, z_plane = self._plane, self._z_plane
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            disc = self._disc_x**2 + self._disc_y**2
            half_rho = np.where(made.by_disc, disc, plane)
            # interpolation factor from the centre's depth to the depth on the plane
            circle = np.where(made.wide, disc, HALF_RHO_OF_RANGE)
            self._share = np.where(made.mirrored, circle / plane, 1.0)
            z = self._pz + self._share * (z_plane - self._pz)
            opacity = np.where(made.clamped, view.ceiling, np.exp(log_opacity - half_rho))
        self._z = np.where(made.contributes, np.where(made.missed, self._pz, z), 0.0)
        self._inverse = np.where(made.contributes, inverse_depth(self._z), 0.0)
        self._alpha = np.where(made.contributes, opacity, 0.0)
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

    def backward(self, by: Samples) -> Placed:
        """Derivatives of a loss with respect to the splats, from derivatives with respect to the samples."""
        made = self._made
        by_inverse = by.inverse[:, None] + 2 * by.squares[:, None] * self._inverse
        by_inverse = np.where(self._z > SPREAD_NEAR, by_inverse, 0.0)
        by_z = self._weight * (by.depth[:, None] - by_inverse * self._inverse**2 / INVERSE_DEPTH)
        by_alpha = np.where(made.contributes, self._by_opacity(by), 0.0)
        by_log = np.where(made.clamped, 0.0, by_alpha * self._alpha)

        met = made.contributes & ~made.missed
        on_plane, mirrored = made.contributes & ~made.by_disc, met & made.mirrored
        share = np.where(met, self._share, 0.0)
        with np.errstate(invalid="ignore", divide="ignore"):
            by_share = np.where(mirrored, by_z * (self._z_plane - self._pz), 0.0)
            # derivative with respect to rho / 2 of the ray-plane intersection
            by_plane = np.where(mirrored, -by_share * share / self._plane, 0.0)
            by_plane -= np.where(on_plane, by_log, 0.0)
            by_disc = np.where(made.contributes & made.by_disc, by_log, 0.0)
            by_disc -= np.where(mirrored & made.wide, by_share / self._plane, 0.0)
        by_facing, by_log_opacity = self._weight.T @ by.normal, by_log.sum(0)
        slopes = Placed.zeros(len(self._pz))
        for rows, shape in self._shapes:
            found = Placed.zeros(len(rows))
            by_rays = (by_plane[:, rows], by_z[:, rows] * share[:, rows], (on_plane | met)[:, rows])
            shape.backward(found, *by_rays, by_facing[rows], by_log_opacity[rows])
            for name, array in vars(found).items():
                getattr(slopes, name)[rows] = array
        for axis, distance in enumerate((self._disc_x, self._disc_y)):
            slopes.center[:, axis] += 2 * np.where(by_disc != 0, by_disc * distance, 0.0).sum(0)
        slopes.p[:, 2] += (by_z * (1 - share)).sum(0)
        slopes.log_opacity, slopes.rgb = by_log_opacity, self._weight.T @ by.rgb
        out = Placed.zeros(self._count)
        for name, array in vars(slopes).items():
            getattr(out, name)[made.order] = array
        return out

    def _by_opacity(self, by: Samples) -> np.ndarray:
        """Derivatives (k, m) with respect to the fragments' opacities: the term of a fragment's own colour
        minus the term of the colour behind it, from back to front."""
        worth = by.rgb @ self._rgb.T + by.normal @ self._facing.T + by.depth[:, None] * self._z
        worth = worth + by.weight[:, None] + by.inverse[:, None] * self._inverse
        worth = worth + by.squares[:, None] * self._inverse**2
        hidden, slopes = by.t.copy(), np.zeros_like(worth)
        for k in range(worth.shape[1] - 1, -1, -1):
            gain = worth[:, k] - hidden
            slopes[:, k] = self._before[:, k] * gain
            hidden = hidden + self._alpha[:, k] * gain
        return slopes
