"""Fisher information about the pose of a camera in the corners of tags."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.util.arguments import number


@dataclass(frozen=True)
class CornerNoise:
    """Model of the error of a corner that is the intersection of two fitted edges.

    An edge of contrast C that is blurred by s pixels, with noise n, has an offset variance of
    2 sqrt(pi) s n^2 / C^2 for each pixel of its length L; the end of a fitted line has 4 / L of it.
    """

    floor: float = 0.05
    """pixels: errors of the detector that blur and noise do not explain"""
    noise: float = 1 / 255
    """standard deviation of a pixel in display values"""
    contrast: float = 1.0
    """difference of white and black in display values"""
    blur: float = 0.5
    """pixels: standard deviation of the blur of an edge at rest"""

    def __post_init__(self) -> None:
        for name in ("floor", "noise", "contrast", "blur"):
            number(f"corner noise: {name}", getattr(self, name), "a number above 0", 1e-9, 1e9)


def pose_jacobian(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Derivative (n, 2, 6) of the pixels of world points (n, 3) by the pose of the camera.

    The six numbers are a translation [m] and a rotation vector [rad] in the camera's axes, camera_to_world
    exp(xi).
    """
    local = (np.asarray(points, np.float64) - camera.position) @ camera.world_to_camera[:3, :3].T
    if camera.lens is not None:
        image = camera.lens.derivative(local)
    else:
        x, y, z = local.T
        zero = np.zeros_like(z)
        with np.errstate(divide="ignore", invalid="ignore"):
            rows = [[1 / z, zero, -x / z**2], [zero, 1 / z, -y / z**2]]
        image = np.moveaxis(np.array(rows), -1, 0)
    image = image * np.array([camera.fx, camera.fy])[:, None]
    x, y, z = local.T
    zero = np.zeros_like(z)
    cross = np.moveaxis(np.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]]), -1, 0)
    return np.concatenate([-image, image @ cross], axis=2)


def corner_covariances(corners: np.ndarray, moved: np.ndarray, noise: CornerNoise) -> np.ndarray:
    """Covariances (n, 4, 2, 2) in square pixels of the corners (n, 4, 2) of tags.

    moved: (n, 4, 2) motion of each corner during the exposure [px].
    """
    edges = np.roll(corners, -1, axis=1) - corners
    length = np.maximum(np.linalg.norm(edges, axis=2), 1e-9)
    normal = np.stack([-edges[..., 1], edges[..., 0]], -1) / length[..., None]
    along = (normal * (moved + np.roll(moved, -1, axis=1)) / 2).sum(2)
    blur = np.sqrt(noise.blur**2 + along**2 / 12)
    variance = 4 / length * 2 * math.sqrt(math.pi) * blur * (noise.noise / noise.contrast) ** 2
    weight = normal[..., :, None] * normal[..., None, :] / variance[..., None, None]
    weight = weight + np.roll(weight, 1, axis=1)
    return np.linalg.pinv(weight, hermitian=True) + noise.floor**2 * np.eye(2)


def tag_information(
    camera: Camera, tags: np.ndarray, noise: CornerNoise, moved: np.ndarray | None = None
) -> np.ndarray:
    """Fisher information (n, 6, 6) about the pose of a camera in the corners (n, 4, 3) of tags, in the world.

    moved: (n, 4, 2) motion of each corner during the exposure [px]; None: no motion.
    """
    n = len(tags)
    flat = np.asarray(tags, np.float64).reshape(-1, 3)
    jacobian = pose_jacobian(camera, flat).reshape(n, 4, 2, 6)
    pixels = camera.project(flat).reshape(n, 4, 2)
    covariance = corner_covariances(pixels, np.zeros_like(pixels) if moved is None else moved, noise)
    return np.einsum("ncai,ncaj->nij", jacobian, np.linalg.solve(covariance, jacobian))
