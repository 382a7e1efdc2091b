"""Camera pose offset: a small rigid motion (6,) of a camera, and the gradient with respect to it."""

from __future__ import annotations

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.screw import rotation_matrix

_SMALL_ANGLE = 1e-3
"""angle in radians below which a series of one term is as accurate as the formula"""


def offset_camera(camera: Camera, offset: np.ndarray) -> Camera:
    """The camera after a motion (6,) in its own axes: rotation vector [rad] and translation [m]."""
    return camera.with_pose(offset_pose(camera.world_to_camera, offset))


def offset_pose(world_to_camera: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a camera after a motion (6,), as in `offset_camera`."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation_matrix(offset[:3]), offset[3:]
    return motion @ world_to_camera


def offset_gradient(by_pose: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Gradient (6,) with respect to an offset, from the gradient `pose` (6,) of a frame of the offset camera.

    `pose` is the gradient with respect to a second motion after the offset: R(w + dw) = R(J dw) R(w), with
    the left Jacobian J of SO(3), whose transpose multiplies it.
    """
    rotation, translation = offset[:3], offset[3:]
    by_rotation = by_pose[:3] - np.cross(translation, by_pose[3:])
    angle = float(np.linalg.norm(rotation))
    first = np.sinc(angle / (2 * np.pi)) ** 2 / 2
    second = 1 / 6 if angle < _SMALL_ANGLE else (1 - np.sinc(angle / np.pi)) / angle**2
    crossed = np.cross(rotation, by_rotation)
    return np.concatenate([by_rotation - first * crossed + second * np.cross(rotation, crossed), by_pose[3:]])
