"""The ideal image of disks in NumPy's float64: no cut-off, no stop, no ceiling, no code of the renderer."""

import numpy as np

import fidsplat as fs
from fidsplat.splats.cloud import sh_basis


def ideal(cloud: fs.SplatCloud, camera: fs.Camera, quality: fs.Quality, background=(0.0, 0.0, 0.0)):
    """(h, w, 3) of a pinhole, in order of the centres' float32 depths; low-pass `screen` or `none`."""
    n, (h, w) = quality.samples, (camera.height, camera.width)
    y, x = (np.mgrid[: h * n, : w * n] + 0.5).reshape(2, -1) / n
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    means = cloud.means.astype(np.float64) + cloud.origin
    centers = means @ rotation.T + shift
    half_rho = _half_rho(*_tangents(cloud, rotation), centers, rays, camera.near)
    if quality.lowpass == "screen":
        ahead = centers[:, 2] >= camera.near
        px, py, pz = centers[ahead].T[:, :, None]
        away = (x - px / pz * camera.fx - camera.cx) ** 2 + (y - py / pz * camera.fy - camera.cy) ** 2
        half_rho[ahead] = np.minimum(half_rho[ahead], away)
    order = np.argsort(centers[:, 2].astype(np.float32), kind="stable")
    alpha = (cloud.opacities.astype(np.float64)[:, None] * np.exp(-half_rho))[order]
    left = np.cumprod(np.concatenate([np.ones((1, len(x))), 1 - alpha]), axis=0)
    colors = _colors(cloud, means - camera.position)[order]
    light = (left[:-1] * alpha).T @ colors + left[-1][:, None] * np.asarray(background)
    return light.reshape(h, n, w, n, 3).mean((1, 3))


def _colors(cloud: fs.SplatCloud, away: np.ndarray) -> np.ndarray:
    """Colours (n, 3) from a camera that the means are `away` (n, 3) from."""
    if cloud.sh is None:
        return cloud.colors.astype(np.float64)
    basis = sh_basis(cloud.sh_degree, away / np.linalg.norm(away, axis=1, keepdims=True))
    return np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, cloud.sh.astype(np.float64)), 0)


def _tangents(cloud: fs.SplatCloud, turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scaled tangents (n, 3) of the splats in the camera frame."""
    q = cloud.quats.astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    u = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    v = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
    scale = cloud.scales.astype(np.float64)
    return u @ turn.T * scale[:, :1], v @ turn.T * scale[:, 1:]


def _half_rho(a, b, p, rays, near):
    """Half the squared distance (n, k) from centres p (n, 3) at which rays (3, k) meet the planes of a, b
    (n, 3); infinite where that is nearer than `near` or behind."""
    normal = np.cross(a, b)
    square = (normal * normal).sum(1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = (normal * p).sum(1)[:, None] / (normal @ rays)
        # (depth ray - p) along the axes that are conjugate to a and b
        u, v = (
            (depth * (axis @ rays) - (axis * p).sum(1)[:, None]) / square
            for axis in (np.cross(b, normal), np.cross(normal, a))
        )
        half = (u * u + v * v) / 2
    return np.where((depth >= near) & np.isfinite(half), half, np.inf)
