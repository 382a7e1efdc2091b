"""The ideal image of disks in NumPy's float64: no cut-off, no stop, no ceiling, no code of the renderer."""

import numpy as np

import fidsplat as fs
from fidsplat.splats import sh_basis


def ideal(cloud: fs.SplatCloud, camera: fs.Camera, quality: fs.Quality, background=(0.0, 0.0, 0.0)):
    """(h, w, 3) of a pinhole, in order of the centres' float32 depths; low-pass `screen` or `none`."""
    n, (h, w) = quality.samples, (camera.height, camera.width)
    y, x = (np.mgrid[: h * n, : w * n] + 0.5).reshape(2, -1) / n
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], 1)
    turn, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    means = cloud.means.astype(np.float64) + cloud.origin
    centers = (means + turn.T @ shift) @ turn.T
    colors = cloud.colors
    if cloud.sh is not None:
        away = means - camera.position
        basis = sh_basis(cloud.sh_degree, away / np.linalg.norm(away, axis=1, keepdims=True))
        colors = np.maximum(0.5 + np.einsum("nk,nkc->nc", basis, cloud.sh.astype(np.float64)), 0)
    light, left = np.zeros((len(x), 3)), np.ones(len(x))
    for i in np.argsort(centers[:, 2].astype(np.float32), kind="stable"):
        (a, b), p = _tangents(cloud, i, turn), centers[i]
        half_rho = _half_rho(a, b, p, rays, camera.near)
        if quality.lowpass == "screen" and p[2] >= camera.near:
            at = p[0] / p[2] * camera.fx + camera.cx, p[1] / p[2] * camera.fy + camera.cy
            half_rho = np.minimum(half_rho, (x - at[0]) ** 2 + (y - at[1]) ** 2)
        alpha = float(cloud.opacities[i]) * np.exp(-half_rho)
        light += (left * alpha)[:, None] * colors[i].astype(np.float64)
        left *= 1 - alpha
    light += left[:, None] * np.asarray(background)
    return light.reshape(h, n, w, n, 3).mean((1, 3))


def _tangents(cloud: fs.SplatCloud, i: int, turn: np.ndarray) -> np.ndarray:
    """Scaled tangents (2, 3) of a splat in the camera frame."""
    w, x, y, z = (q := cloud.quats[i].astype(np.float64)) / np.linalg.norm(q)
    u = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    v = [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]
    return np.array([u, v]) @ turn.T * cloud.scales[i].astype(np.float64)[:, None]


def _half_rho(a, b, p, rays, near):
    """Half the squared distance (k,) from the centre where rays (k, 3) meet the splat's plane; infinite where
    that is nearer than `near` or behind."""
    normal = np.cross(a, b)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depth = (normal @ p) / (rays @ normal)
        off = depth[:, None] * rays - p
        square = normal @ normal
        u = np.cross(off, b) @ normal / square
        v = np.cross(a, off) @ normal / square
        half = (u * u + v * v) / 2
    return np.where((depth >= near) & np.isfinite(half), half, np.inf)
