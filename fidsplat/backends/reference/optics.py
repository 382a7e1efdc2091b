"""Camera models of the reference: rays of samples, and the linear forms of splats in the rays' coordinates.

A sample has three coordinates, in which the numerators n_u, n_v and the denominator D of a splat are linear:
1, x, y for a pinhole or parallel rays, X, Y, Z of the sample's float32 ray behind a lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.view import View

ROUND = 4 * 2.0**-24
"""rounding error of a form relative to its terms, from its coefficients and sums"""
ROUND_OF_RAYS = 6 * 2.0**-24
"""the same for a lens, with one more term and the rounding of the distance from the anchor"""


@dataclass
class Samples:
    """k samples: positions x, y (k, 1) on the grid and coordinates (3, k, 1)."""

    x: np.ndarray
    y: np.ndarray
    coordinates: np.ndarray
    """0 without a ray"""
    valid: np.ndarray
    """(k, 1) bool"""


def samples_of(view: View, x: np.ndarray, y: np.ndarray) -> Samples:
    """Samples at grid positions x, y (k,)."""
    if view.raster is None:
        one = np.ones_like(x)
        return Samples(x[:, None], y[:, None], np.stack([one, x, y])[:, :, None], one[:, None] > 0)
    rays = view.raster.rays[y.astype(int), x.astype(int)].astype(np.float64)
    valid = np.isfinite(rays[:, :1])
    coordinates = np.where(valid, rays, 0.0).T[:, :, None]
    return Samples(x[:, None], y[:, None], coordinates, valid)


def rays_of(view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (k, 3) in the camera frame of the rays through samples at grid positions x, y (k,), with z =
    1 or of unit length; and whether a sample has a ray (k,)."""
    if view.raster is not None:
        rays = view.raster.rays[y.astype(int), x.astype(int)].astype(np.float64)
        return rays, np.isfinite(rays[:, 0])
    one = np.ones_like(x)
    across = (
        (0 * x, 0 * y)
        if view.parallel
        else ((x - view.center_x) / view.focal_x, (y - view.center_y) / view.focal_y)
    )
    return np.stack([*across, one], 1), one > 0


def ray_lengths(x: np.ndarray, y: np.ndarray, view: View) -> np.ndarray:
    """Length (k,) of the rays through samples at grid positions x, y, per metre of depth; 1 without a ray."""
    if view.along_ray or view.parallel:
        return np.ones_like(x)
    rays, valid = rays_of(view, x.ravel(), y.ravel())
    return np.where(valid, np.linalg.norm(rays, axis=1), 1.0).reshape(x.shape)


def forms_of(view: View, a: np.ndarray, b: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Linear forms of splats with scaled tangents a, b and centres p (n, 3) in the camera frame.

    Returns (3, n, 3) coefficients of the coordinates in n_u, n_v and D; (3, n) coefficients in D times the
    depth, for parallel rays; and, for other rays, D times the depth divided by the volume of a, b, p.
    """
    if view.raster is not None:
        forms = np.stack([np.cross(b, p), np.cross(p, a), np.cross(a, b)], axis=2)
        return np.moveaxis(forms, 1, 0), np.zeros((3, len(p))), 1.0
    rows = np.stack([a, b, p], axis=2)  # (n, xyz, uv1)
    tw = np.broadcast_to([0.0, 0.0, 1.0], rows[:, 2].shape) if view.parallel else rows[:, 2]
    tu = view.focal_x * rows[:, 0] + view.center_x * tw
    tv = view.focal_y * rows[:, 1] + view.center_y * tw
    forms = np.stack([np.cross(tu, tv), np.cross(tv, tw), np.cross(tw, tu)])
    return forms, np.einsum("inc,nc->in", forms, rows[:, 2]), view.focal_x * view.focal_y


def centers_of(view: View, p: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project centres p (n, 3) to samples; infinite where not `known`, or where the lens has no image."""
    if view.raster is not None or view.parallel:
        image = p[:, :2] if view.raster is None else view.raster.lens.image(p)
        x, y = (image * (view.focal_x, view.focal_y) + (view.center_x, view.center_y)).T
        known = known & np.isfinite(x)
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            x = (view.focal_x * p[:, 0] + view.center_x * p[:, 2]) / p[:, 2]
            y = (view.focal_y * p[:, 1] + view.center_y * p[:, 2]) / p[:, 2]
    return np.where(known, x, np.inf), np.where(known, y, np.inf)


def derivatives_of(view: View, p: np.ndarray) -> np.ndarray:
    """Jacobian (n, 2, 3) of the projection of points p (n, 3) to samples; NaN where the lens has no image."""
    if view.lens is None:
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y, ahead = p[:, 0] / p[:, 2], p[:, 1] / p[:, 2], 1 / p[:, 2]
            none = np.zeros_like(x)
            slopes = np.stack([ahead, none, -x * ahead, none, ahead, -y * ahead], 1).reshape(-1, 2, 3)
    else:
        valid = np.isfinite(view.lens.image(p)[:, 0])[:, None, None]
        slopes = np.where(valid, view.lens.derivative(p), np.nan)
    return slopes * np.array([[view.focal_x], [view.focal_y]])


def along_of(view: View, p: np.ndarray) -> np.ndarray:
    """Derivative (n, 3) of log(depth) with respect to points p (n, 3); 0 for parallel rays."""
    if view.parallel:
        return np.zeros_like(p)
    if view.along_ray:
        return p / np.einsum("ni,ni->n", p, p)[:, None]
    return np.array([0.0, 0.0, 1.0]) / p[:, 2:]


def edges_of(view: View, forms: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse gradients of the edge functions of boxes with linear `forms` (3, n, 3), at samples (k,).

    Returns 1 / |gradient| of D + n_u, D - n_u, D + n_v, D - n_v with respect to the sample position, (4, n),
    or (4, k, n) behind a lens; and the sum of absolute terms relative to the gradient, for its rounding
    error.
    """
    sides = [(axis, sign) for axis in (0, 1) for sign in (1, -1)]
    if view.raster is None:
        steep = [np.hypot(*(forms[1:, :, 2] + sign * forms[1:, :, axis])) for axis, sign in sides]
        return 1 / np.maximum(np.stack(steep), 1e-300), np.zeros((4, 1))
    slopes = np.nan_to_num(
        view.raster.ray_derivatives[y.astype(int), x.astype(int)].astype(np.float64)
    )  # (k, 2, 3)
    edges, terms = [], []
    for axis, sign in sides:
        form = forms[:, :, 2] + sign * forms[:, :, axis]
        edges.append(1 / np.maximum(np.hypot(*np.einsum("kic,cn->ikn", slopes, form)), 1e-300))
        parts = np.abs(forms[:, :, 2]) + np.abs(forms[:, :, axis])
        terms.append(np.hypot(*np.einsum("kic,cn->ikn", np.abs(slopes), parts)))
    return np.stack(edges), np.stack(terms) * np.stack(edges)


def anchors_of(view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coordinates (3, n) of the anchor pixels (x, y) relative to which devices store forms; NaN if
    unknown."""
    if view.raster is None:
        return np.stack([np.ones_like(x), x, y])
    known = (x > 0) & (y > 0)
    rays = view.raster.rays[np.where(known, y, 0).astype(int), np.where(known, x, 0).astype(int)]
    return np.where(known[:, None], rays, np.nan).T.astype(np.float64)


def away_of(view: View, samples: Samples, anchors: np.ndarray) -> np.ndarray:
    """Upper bound (3, k, n) of the distance of samples from the anchors along each coordinate."""
    away = np.abs(samples.coordinates - anchors[:, None, :])
    if view.raster is not None:
        furthest = np.nanmax(np.abs(view.raster.rays), axis=(0, 1), initial=1.0)[:, None, None]
        away = np.where(np.isnan(away), np.abs(samples.coordinates) + furthest, away)
    return np.where(samples.valid, away, 0.0)
