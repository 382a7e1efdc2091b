"""Splats in the camera's frame, as differentiable functions of the parameters; float64."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from fidsplat.backends.view import View
from fidsplat.splats.cloud import SplatCloud, sh_basis

_SMALLEST = float(np.float32(1e-20))
"""metres: smallest scale that is rendered"""


@dataclass
class Parameters:
    """Parameters with respect to which a frame is differentiated."""

    means: np.ndarray
    quats: np.ndarray
    """(n, 4) quaternions of any length"""
    scales: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray | None
    sh: np.ndarray | None
    background: np.ndarray
    pose: np.ndarray
    """(6,): rotation vector [rad] and translation [m] of a motion after world_to_camera, in camera axes"""
    intrinsics: np.ndarray
    """(4,): fx, fy, cx, cy [samples]"""
    thickness: np.ndarray | None = None
    """(n,) third standard deviations of 3D Gaussians [m], 0 of disks; None if all are disks"""

    @classmethod
    def of(cls, cloud: SplatCloud, view: View) -> Parameters:
        """Parameters of a frame in float64; the pose is 0."""
        arrays = (cloud.means, cloud.quats, cloud.scales, cloud.opacities)
        color = cloud.colors if cloud.colors is not None else cloud.plain_colors
        sh = None if color is not None else cloud.sh
        given = [None if array is None else array.astype(np.float64) for array in (*arrays, color, sh)]
        thickness = None if cloud.thickness is None else cloud.thickness.astype(np.float64)
        background = np.array(view.background, np.float64)
        intrinsics = np.array([view.focal_x, view.focal_y, view.center_x, view.center_y], np.float64)
        return cls(*given, background, np.zeros(6), intrinsics, thickness)  # type: ignore[arg-type]

    @property
    def names(self) -> list[str]:
        return [one.name for one in fields(self) if getattr(self, one.name) is not None]

    def view(self, view: View) -> View:
        """The view with these intrinsics. The limits of EWA's slopes are constant in samples."""
        fx, fy, cx, cy = self.intrinsics.tolist()
        x, y = (fx, view.focal_x, cx - view.center_x), (fy, view.focal_y, cy - view.center_y)
        limits = zip(view.ewa_clamp, (x, x, y, y), (1, -1, 1, -1), strict=True)
        slopes = tuple((limit * old + sign * moved) / new for limit, (new, old, moved), sign in limits)
        return replace(view, focal_x=fx, focal_y=fy, center_x=cx, center_y=cy, ewa_clamp=slopes)


@dataclass
class CameraSplats:
    """Splats in the camera's frame; also used for the derivatives of a loss with respect to each array."""

    unit_a: np.ndarray
    """(n, 3) unit tangents"""
    unit_b: np.ndarray
    p: np.ndarray
    """(n, 3) centres [m]"""
    center: np.ndarray
    """(n, 2) projected centres [samples]; undefined behind the camera"""
    scales: np.ndarray
    """(n, 3) rendered scales [m]; the third is 0 for disks"""
    log_opacity: np.ndarray
    rgb: np.ndarray
    intrinsics: np.ndarray
    """(n, 4), only for derivatives: with respect to fx, fy, cx, cy by splat, except through `center`"""

    @classmethod
    def zeros(cls, n: int) -> CameraSplats:
        """Zero derivatives of n splats."""
        a, b, p, scales, rgb = np.zeros((5, n, 3))
        return cls(a, b, p, np.zeros((n, 2)), scales, np.zeros(n), rgb, np.zeros((n, 4)))

    def select(self, rows: np.ndarray) -> CameraSplats:
        return CameraSplats(*(array[rows] for array in vars(self).values()))


def motion_of(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert a rotation vector and translation (6,) to a rotation matrix (3, 3) and a translation (3,)."""
    angle = np.linalg.norm(pose[:3])
    if angle == 0:
        return np.eye(3), pose[3:]
    x, y, z = pose[:3] / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross, pose[3:]


def to_camera(parameters: Parameters, view: View) -> CameraSplats:
    """Transform splats to the camera frame."""
    rotation_offset, translation_offset = motion_of(parameters.pose)
    rotation, translation = (
        rotation_offset @ view.rotation,
        rotation_offset @ view.translation + translation_offset,
    )
    tangent_u, tangent_v = _tangents(parameters.quats)
    p = parameters.means @ rotation.T + translation
    third = np.zeros(len(p)) if parameters.thickness is None else parameters.thickness
    third = np.where(third > 0, np.maximum(third, _SMALLEST), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_opacity = np.log(parameters.opacities)
        focal, middle = (view.focal_x, view.focal_y), (view.center_x, view.center_y)
        center = p[:, :2] * focal / p[:, 2:] + middle
    return CameraSplats(
        tangent_u @ rotation.T,
        tangent_v @ rotation.T,
        p,
        center,
        np.column_stack([np.maximum(parameters.scales, _SMALLEST), third]),
        log_opacity,
        _rgb(parameters, _eye(parameters, view)),
        np.zeros((len(p), 4)),
    )


def to_camera_backward(parameters: Parameters, view: View, splats: CameraSplats, grads: CameraSplats) -> dict:
    """Derivatives with respect to the parameters, from derivatives with respect to the transformed splats."""
    rotation = view.rotation
    grad_color, grad_ray = _rgb_backward(parameters, _eye(parameters, view), grads.rgb)
    grad_p = grads.p + center_backward(view, splats.p, grads.center)
    pairs = [(grads.unit_a, splats.unit_a), (grads.unit_b, splats.unit_b), (grad_p, splats.p)]
    rotation_grad = sum(np.cross(vector, grad).sum(0) for grad, vector in pairs)
    # a translation by t moves the camera centre by -t; the rotation is about the centre
    translation_grad = grad_p.sum(0) + grad_ray.sum(0) @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        grad_opacity = grads.log_opacity / parameters.opacities
        tangents = np.where(grads.center != 0, splats.p[:, :2] / splats.p[:, 2:], 0.0)
    grad_focal = (grads.center * tangents).sum(0)
    rendered = grads.scales[:, :2]
    results = {
        "means": grad_p @ rotation + grad_ray,
        "quats": _tangents_backward(parameters.quats, grads.unit_a @ rotation, grads.unit_b @ rotation),
        "scales": np.where(parameters.scales >= _SMALLEST, rendered, 0.0),
        "opacities": np.where(grads.log_opacity != 0, grad_opacity, 0.0),
        "sh" if parameters.colors is None else "colors": grad_color,
        "pose": np.concatenate([rotation_grad, translation_grad]),
        "intrinsics": grads.intrinsics.sum(0) + np.concatenate([grad_focal, grads.center.sum(0)]),
    }
    if parameters.thickness is not None:
        results["thickness"] = np.where(parameters.thickness >= _SMALLEST, grads.scales[:, 2], 0.0)
    return results


def center_backward(view: View, p: np.ndarray, grad_center: np.ndarray) -> np.ndarray:
    """Derivatives (n, 3) with respect to centres, from derivatives (n, 2) with respect to their
    projections."""
    with np.errstate(divide="ignore", invalid="ignore"):
        across = grad_center * (view.focal_x, view.focal_y) / p[:, 2:]
        grad_p = np.column_stack([across, -(across * p[:, :2]).sum(1) / p[:, 2]])
    return np.where((grad_center != 0).any(axis=1, keepdims=True), grad_p, 0.0)


def _tangents(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The first two columns of the rotations of quaternions of any length."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
    )


def _tangents_backward(quats: np.ndarray, grad_u: np.ndarray, grad_v: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = unit = (quats / length).T
    (ux, uy, uz), (vx, vy, vz) = grad_u.T, grad_v.T
    slopes = 2 * np.stack(
        [
            uy * z - uz * y - vx * z + vz * x,
            uy * y + uz * z + vx * y - 2 * vy * x + vz * w,
            -2 * ux * y + uy * x - uz * w + vx * x + vz * z,
            -2 * ux * z + uy * w + uz * x - vx * w - 2 * vy * z + vz * y,
        ]
    )
    # scaling a quaternion has no effect, so the derivative along it is 0
    return ((slopes - unit * (unit * slopes).sum(0)) / length.T).T


def _eye(parameters: Parameters, view: View) -> np.ndarray:
    rotation_offset, translation_offset = motion_of(parameters.pose)
    return view.eye - view.rotation.T @ (rotation_offset.T @ translation_offset)


def _rgb(parameters: Parameters, eye: np.ndarray) -> np.ndarray:
    if parameters.sh is None:
        assert parameters.colors is not None
        return parameters.colors
    return np.maximum(_unclamped(parameters.sh, _directions(parameters.means - eye)[0]), 0)


def _directions(rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    length = np.where(length > 0, length, np.inf)
    return rays / length, length


def _degree(sh: np.ndarray) -> int:
    return {4: 1, 9: 2, 16: 3}[sh.shape[1]]


def _unclamped(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return 0.5 + np.einsum("nk,nkc->nc", sh_basis(_degree(sh), directions), sh)


def _rgb_backward(
    parameters: Parameters, eye: np.ndarray, grad_rgb: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of the loss with respect to SH coefficients or colours, and to the vectors from the camera
    centre to the means (n, 3). grad_rgb: (n, 3) gradient with respect to the rendered colours."""
    if parameters.sh is None:
        return grad_rgb, np.zeros_like(grad_rgb)
    directions, length = _directions(parameters.means - eye)
    grad_rgb = np.where(_unclamped(parameters.sh, directions) > 0, grad_rgb, 0.0)
    degree = _degree(parameters.sh)
    grad_basis = np.einsum("nc,nkc->nk", grad_rgb, parameters.sh)
    slopes = np.stack(
        [np.einsum("nk,nk->n", grad_basis, _basis_slope(degree, directions, axis)) for axis in range(3)], 1
    )
    across = slopes - directions * (directions * slopes).sum(1, keepdims=True)
    return np.einsum("nk,nc->nkc", sh_basis(degree, directions), grad_rgb), across / length


def _basis_slope(degree: int, directions: np.ndarray, axis: int) -> np.ndarray:
    """Derivatives (n, k) of the SH basis with respect to a coordinate, by Richardson extrapolation of central
    differences, which is exact for degree 3."""

    def difference(h: float) -> np.ndarray:
        step = np.zeros(3)
        step[axis] = h
        ahead, behind = sh_basis(degree, directions + step), sh_basis(degree, directions - step)
        return (ahead - behind) / (2 * h)

    return (4 * difference(0.5) - difference(1.0)) / 3
