"""3D Gaussians as disks with the same image (docs/primitives.md).

`exact`: W maps the covariance to the unit matrix. In that space the disk contains the centre W p and is
perpendicular to it. For a ray that meets the disk at the squared distance rho from the centre, the squared
distance of ray and centre is rho / (1 + rho / |W p|^2). `ewa`: a disk parallel to the image plane whose image
has the covariance that 3DGS computes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.view import View

_ROUND = 1e-15  # rounding error of a direction in float64
EWA_SPREAD = 0.3
"""square pixels: low-pass variance that 3DGS adds to every projected covariance"""


@dataclass
class Axes:
    """Disks in the camera frame, (n, 3) or (n,)."""

    a: np.ndarray
    """scaled tangent"""
    b: np.ndarray
    normal: np.ndarray
    """unit"""
    surface: np.ndarray
    """unit normal (n, 3) of the visible surface"""
    area: np.ndarray
    """|a x b|"""
    third: np.ndarray
    """semi-axis of the ellipsoid conjugate to a and b; 0 for disks"""
    inverse_m2: np.ndarray
    """1 / |W p|^2; 0 for disks"""
    opacity_term: np.ndarray
    """term added to the logarithm of the opacity"""
    normal_error: np.ndarray
    """error bound of the normal [rad], large for flat ellipsoids near edge-on"""


def disks(unit_a: np.ndarray, unit_b: np.ndarray, scale: np.ndarray) -> Axes:
    """Axes of disks with unit tangents (n, 3) and standard deviations (n, 2)."""
    n, area = len(scale), scale.prod(axis=1)
    a, b, normal = unit_a * scale[:, :1], unit_b * scale[:, 1:], np.cross(unit_a, unit_b)
    return Axes(a, b, normal, normal.copy(), area, np.zeros((n, 3)), np.zeros(n), np.zeros(n), np.zeros(n))


def exact(axes: np.ndarray, scales: np.ndarray, p: np.ndarray, view: View) -> Axes:
    """Axes of 3D Gaussians with unit axes (n, 3, 3), in rows, standard deviations `scales` (n, 3) and centres
    p (n, 3)."""
    towards = np.broadcast_to([0.0, 0.0, 1.0], p.shape) if view.parallel else p
    white = np.einsum("nkc,nc->nk", axes, towards) / scales
    m = np.linalg.norm(white, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        e3 = white / m[:, None]
        # cross product with the longest axis, to avoid cancellation
        e2 = np.cross(e3, np.eye(3)[np.argmax(scales, axis=1)])
        length = np.linalg.norm(e2, axis=1)
        e2 = np.where((length > 0)[:, None], e2 / length[:, None], np.roll(e3, 1, axis=1))
        e1 = np.cross(e2, e3)
        a, b = (np.einsum("nk,nkc->nc", e * scales, axes) for e in (e1, e2))
        normal, normal_error = _surface_normals(axes, scales, towards)
        area = scales.prod(axis=1) * m / np.einsum("nc,nc->n", normal, towards)
        none = np.zeros(len(p))
        inverse_m2 = none if view.parallel else 1 / m**2
        return Axes(a, b, normal, normal, area, towards / m[:, None], inverse_m2, none, normal_error)


def _surface_normals(
    axes: np.ndarray, scales: np.ndarray, towards: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (n, 3) as in RaDe-GS and GOF, along the inverse covariance times the ray through the
    centre, and their rounding error [rad]."""
    shares = (scales.min(axis=1)[:, None] / scales) ** 2
    normal = np.einsum("nk,nkc->nc", np.einsum("nkc,nc->nk", axes, towards) * shares, axes)
    length = np.linalg.norm(normal, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return normal / length[:, None], _ROUND * np.linalg.norm(towards, axis=1) / length


def ewa(axes: np.ndarray, scales: np.ndarray, p: np.ndarray, view: View, antialiased: bool) -> Axes:
    """Axes of 3D Gaussians in the EWA projection of 3DGS; undefined for centres behind the near plane."""
    scaled = axes * scales[:, :, None]
    z = p[:, 2]
    ahead = np.ones_like(z) if view.parallel else np.where(z > 0, z, 1.0)
    slope_x, slope_y = np.zeros_like(z), np.zeros_like(z)
    if not view.parallel:
        left, right, up, down = view.ewa_clamp
        slope_x, slope_y = np.clip(p[:, 0] / ahead, -left, right), np.clip(p[:, 1] / ahead, -up, down)
    per_x, per_y = view.focal_x / ahead, view.focal_y / ahead
    x = (scaled[:, :, 0] - slope_x[:, None] * scaled[:, :, 2]) * per_x[:, None]
    y = (scaled[:, :, 1] - slope_y[:, None] * scaled[:, :, 2]) * per_y[:, None]
    spread = EWA_SPREAD * view.samples**2
    xx, xy, yy = (x * x).sum(1), (x * y).sum(1), (y * y).sum(1)
    before = (np.cross(x, y) ** 2).sum(1)
    after = before + spread * (xx + yy + spread)
    l11 = np.sqrt(xx + spread)
    none, one = np.zeros_like(z), np.ones_like(z)
    a = np.stack([l11 / per_x, xy / l11 / per_y, none], 1)
    b = np.stack([none, np.sqrt(after) / l11 / per_y, none], 1)
    normal = np.stack([none, none, one], 1)
    with np.errstate(divide="ignore"):
        opacity_term = 0.5 * np.log(before / after) if antialiased else none
    towards = np.broadcast_to([0.0, 0.0, 1.0], p.shape) if view.parallel else p
    surface, normal_error = _surface_normals(axes, scales, towards)
    return Axes(a, b, normal, surface, a[:, 0] * b[:, 1], np.zeros_like(a), none, opacity_term, normal_error)
