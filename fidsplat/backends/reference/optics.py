"""Cameras of the reference: rays of samples, and the affine forms of a splat for each camera model.

A sample has three coordinates, in which the numerators n_u, n_v and the denominator D of a splat are linear:
1, x, y for a pinhole or parallel rays, and X, Y, Z of the sample's float32 ray behind a lens.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.view import View

ROUND = 4 * 2.0**-24
"""of a form, relative to its terms: its coefficients' rounding, and its sums'"""
ROUND_OF_RAYS = 6 * 2.0**-24
"""the same with one more term, and with the rounding of the distance from the anchor"""


@dataclass
class Samples:
    """k samples: positions x, y (k, 1) on the grid and coordinates (3, k, 1)."""

    x: np.ndarray
    y: np.ndarray
    coordinates: np.ndarray
    """0 where there is no ray"""
    valid: np.ndarray
    """(k, 1) bool"""


def samples_of(view: View, x: np.ndarray, y: np.ndarray) -> Samples:
    """The samples at grid positions x, y (k,)."""
    if view.raster is None:
        one = np.ones_like(x)
        return Samples(x[:, None], y[:, None], np.stack([one, x, y])[:, :, None], one[:, None] > 0)
    rays = view.raster.rays[y.astype(int), x.astype(int)].astype(np.float64)
    valid = np.isfinite(rays[:, :1])
    coordinates = np.where(valid, rays, 0.0).T[:, :, None]
    return Samples(x[:, None], y[:, None], coordinates, valid)


def rays_of(view: View, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions (k, 3) in the camera frame of the rays through samples at grid positions x, y (k,), along z
    1 or of unit length; and whether there is one (k,)."""
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
    """Length (k,) of the rays through samples at grid positions x, y, per metre of depth; 1 where there is
    none."""
    if view.along_ray or view.parallel:
        return np.ones_like(x)
    rays, valid = rays_of(view, x.ravel(), y.ravel())
    return np.where(valid, np.linalg.norm(rays, axis=1), 1.0).reshape(x.shape)


def forms_of(view: View, a: np.ndarray, b: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Forms of splats with scaled tangents a, b and centres p (n, 3), camera frame.

    Returns:
        (3, n, 3) factors of the coordinates in n_u, n_v, D; (3, n) those in D times the depth, for parallel
        rays; and what the volume of a, b, p is multiplied by to give D times the depth, for others.
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
    """Image positions of centres p (n, 3) [samples]; infinite where not `known` or without an image."""
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
    """Jacobian (n, 2, 3) of the image positions [samples] of points p (n, 3); NaN where a lens has no image
    of them."""
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
    """The derivative (n, 3) of the logarithm of points' depths by their coordinates p (n, 3), as the view
    means depth; 0 for parallel rays."""
    if view.parallel:
        return np.zeros_like(p)
    if view.along_ray:
        return p / np.einsum("ni,ni->n", p, p)[:, None]
    return np.array([0.0, 0.0, 1.0]) / p[:, 2:]


def edges_of(view: View, forms: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges of boxes with `forms` (3, n, 3), at samples (k,) on the grid.

    Returns:
        1 / |gradient| of D + n_u, D - n_u, D + n_v, D - n_v by the sample's position, (4, n) or, where each
        sample has a ray of its own, (4, k, n); and what the gradients' terms come to, relative to them (0
        where devices have them from their set-up).
    """
    sides = [(axis, sign) for axis in (0, 1) for sign in (1, -1)]
    if view.raster is None:
        steep = [np.hypot(*(forms[1:, :, 2] + sign * forms[1:, :, axis])) for axis, sign in sides]
        return 1 / np.maximum(np.stack(steep), 1e-300), np.zeros((4, 1))
    slopes = np.nan_to_num(view.raster.slopes[y.astype(int), x.astype(int)].astype(np.float64))  # (k, 2, 3)
    edges, terms = [], []
    for axis, sign in sides:
        form = forms[:, :, 2] + sign * forms[:, :, axis]
        edges.append(1 / np.maximum(np.hypot(*np.einsum("kic,cn->ikn", slopes, form)), 1e-300))
        parts = np.abs(forms[:, :, 2]) + np.abs(forms[:, :, axis])
        terms.append(np.hypot(*np.einsum("kic,cn->ikn", np.abs(slopes), parts)))
    return np.stack(edges), np.stack(terms) * np.stack(edges)


def anchors_of(view: View, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Coordinates (3, n) about which devices store the forms of splats with anchor pixels (x, y); NaN where
    unknown."""
    if view.raster is None:
        return np.stack([np.ones_like(x), x, y])
    known = (x > 0) & (y > 0)
    rays = view.raster.rays[np.where(known, y, 0).astype(int), np.where(known, x, 0).astype(int)]
    return np.where(known[:, None], rays, np.nan).T.astype(np.float64)


def away_of(view: View, samples: Samples, anchors: np.ndarray) -> np.ndarray:
    """Upper bound (3, k, n) of the distance of samples from the anchors, by coordinate."""
    away = np.abs(samples.coordinates - anchors[:, None, :])
    if view.raster is not None:
        furthest = np.nanmax(np.abs(view.raster.rays), axis=(0, 1), initial=1.0)[:, None, None]
        away = np.where(np.isnan(away), np.abs(samples.coordinates) + furthest, away)
    return np.where(samples.valid, away, 0.0)
