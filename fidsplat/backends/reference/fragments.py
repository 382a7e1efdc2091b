"""Fragments: intersections of samples' rays with splats, before compositing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.backends.reference.optics import away_of, edges_of, samples_of
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View

_NO_EDGES = np.zeros((4, 0))
HALF_RHO_OF_RANGE = math.log(255)
"""rho / 2 at which a splat is 1/255 of its opacity"""
MAX_OPTICAL_DEPTH = 24 * math.log(2)
"""optical depth at which the transmittance is 0 in float32"""


@dataclass
class Fragments:
    """Intersections of the rays of k samples with n splats; arrays (k, n) float64."""

    dx: np.ndarray
    """distance in samples from the splat's anchor, the pixel nearest to its projected centre"""
    dy: np.ndarray
    away: np.ndarray
    """(3, k, n) upper bound of the distance from the anchor, by coordinate"""
    n_u: np.ndarray
    n_v: np.ndarray
    d: np.ndarray
    dz: np.ndarray
    """depth times d; (n,) unless rays are parallel"""
    offset: np.ndarray
    """squared distance from the projected centre, square pixels; infinite where the sample has no ray"""
    alpha: np.ndarray
    z: np.ndarray
    edges: np.ndarray
    """results of `edges_of` for clouds with boxes"""
    edge_terms: np.ndarray


def fragments_of(s: ProjectedSplats, view: View, x: np.ndarray, y: np.ndarray) -> Fragments:
    """The fragments of samples (k,) at grid positions x, y."""
    samples = samples_of(view, x, y)
    edges, edge_terms = edges_of(view, s.forms, x, y) if s.box.any() else (_NO_EDGES, _NO_EDGES)
    x, y, (c0, c1, c2) = samples.x, samples.y, samples.coordinates
    n_u, n_v, d = (c0 * s.forms[0, :, c] + c1 * s.forms[1, :, c] + c2 * s.forms[2, :, c] for c in range(3))
    dz = s.z_numerator
    if s.depth_forms is not None:
        dz = c0 * s.depth_forms[0] + c1 * s.depth_forms[1] + c2 * s.depth_forms[2]
    d_solid, q = ellipsoid_forms(s.inverse_m2, d, n_u * n_u + n_v * n_v)
    inside = (q <= 2 * s.half_r2 * d_solid * d_solid) & (d_solid > 0) & (d_solid * view.near <= dz)
    offset = ((x - s.center_x) ** 2 + (y - s.center_y) ** 2) / view.samples**2
    offset = np.where(samples.valid, offset, np.inf)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        half_rho = np.where(inside, q / (2 * d_solid * d_solid), np.inf)
        z = dz / d_solid
        if s.has_screen_lowpass:
            # depths beyond the disc's circle are mirrored at it
            circle = np.maximum(offset, HALF_RHO_OF_RANGE)
            mirrored = s.pz + circle * (dz - s.pz * d_solid) * (2 * d_solid / q)
            z = np.where((q <= 2 * circle * d_solid**2) | s.coplanar, z, mirrored)
    if s.has_screen_lowpass:
        half_rho = np.minimum(half_rho, np.where(offset <= s.half_r2, offset, np.inf))
    alpha = np.minimum(np.exp(s.log_opacity - half_rho), view.opacity_ceiling)
    if s.box.any():
        visible = (d > 0) & (d * view.near <= dz)
        full_opacity = np.minimum(np.exp(s.log_opacity), view.opacity_ceiling)
        alpha = np.where(s.box, np.where(visible, full_opacity * cover(edges, n_u, n_v, d, 0.0), 0.0), alpha)
    meets_plane = (d_solid > 0) & (d_solid * view.near <= dz)
    z = np.where(meets_plane, np.clip(z, s.z_low, s.z_high), s.pz)
    dx, dy, away = np.abs(x - s.anchor_x), np.abs(y - s.anchor_y), away_of(view, samples, s.anchors)
    return Fragments(dx, dy, away, n_u, n_v, d, dz, offset, alpha, z, edges, edge_terms)


def ellipsoid_forms(inverse_m2: np.ndarray, d: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert D and q = n_u^2 + n_v^2 (k, n) of equivalent disks to D and q of 3D Gaussians: rho = q / D^2 is
    divided by 1 + rho / m^2. inverse_m2 (n,): 0 for disks."""
    if not inverse_m2.any():
        return d, q
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        growth = np.where((inverse_m2 > 0) & (d > 0), 1 + inverse_m2 * (q / (d * d)), 1.0)
        return d * growth, q * growth


def cover(edges: np.ndarray, n_u: np.ndarray, n_v: np.ndarray, d: np.ndarray, shift) -> np.ndarray:
    """Coverage (k, n) of samples by boxes, 0 to 1, with each of the 4 edges moved outwards by `shift`
    samples, broadcast to (4, k, n)."""
    shift = np.broadcast_to(shift, (4, *d.shape))

    def ramp(form: np.ndarray, edge: int) -> np.ndarray:
        return np.clip(0.5 + form * edges[edge] + shift[edge], 0, 1)

    along_u = np.maximum(ramp(d + n_u, 0) + ramp(d - n_u, 1) - 1, 0)
    return along_u * np.maximum(ramp(d + n_v, 2) + ramp(d - n_v, 3) - 1, 0)


def optical_depth(alpha: np.ndarray) -> np.ndarray:
    """-ln(1 - alpha), at most `MAX_OPTICAL_DEPTH`."""
    return np.minimum(-np.log1p(-np.clip(alpha, 0.0, 1 - 2.0**-24)), MAX_OPTICAL_DEPTH)


def shifted(after: np.ndarray, last: bool = False) -> np.ndarray:
    """Transmittance in front of each fragment (k, n), from the transmittance behind it. last: append the
    final transmittance."""
    before = np.concatenate([np.ones((len(after), 1)), after], axis=1)
    return before if last else before[:, :-1]
