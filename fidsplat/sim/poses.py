"""Poses (..., 7) float64 in the layout of simulators: x y z in metres and a unit quaternion w x y z.

All arithmetic is element by element, so that the result for a pose does not depend on its batch.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_multiply, quaternion_to_matrix
from fidsplat.util.arguments import LARGEST, real_array
from fidsplat.util.errors import InputError

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
OPENGL = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
"""180 degrees about x: cameras of OpenGL look along -z with y up, ours along z with y down"""
OPTICAL = np.array([0.0, 0.0, 0.0, 0.5, -0.5, 0.5, -0.5])
"""rotation from camera to sensor axes: SDF sensors look along x with z up, our cameras along z with y down"""
UNIT = 1e-3
"""tolerance of a quaternion's length, for rounding of float32 and integrators"""


def check_poses(name: str, poses: Any, axes: tuple[str, ...]) -> np.ndarray:
    """Validate poses of the shape (*axes, 7), and return them as float64 with normalised quaternions.

    Raises:
        InputError: another shape, a number that is not finite, or a quaternion that is not of unit length;
            the message has the index of the first invalid pose.
    """
    array = real_array(name, poses, "poses x y z qw qx qy qz")
    if array.ndim != len(axes) + 1 or array.shape[-1] != 7:
        shape = f"({', '.join(axes)}, 7)" if axes else "(7,)"
        raise InputError(f"{name} must have the shape {shape}, got {array.shape}")
    usable = np.isfinite(array).all(-1) & (np.abs(array[..., :3]) <= LARGEST).all(-1)
    if not usable.all():
        at = np.argwhere(~usable)[0].tolist()
        raise InputError(f"{name}{at or ''} must have finite numbers, got {_shown(array, at)}")
    w, x, y, z = np.moveaxis(array[..., 3:], -1, 0)
    length = np.sqrt(w * w + x * x + y * y + z * z)
    rigid = np.abs(length - 1) <= UNIT
    if not rigid.all():
        at = np.argwhere(~rigid)[0].tolist()
        raise InputError(
            f"{name}{at or ''} must have a quaternion (w, x, y, z) of length 1, got "
            f"{_shown(array, at)} of length {length[tuple(at)]:.4g}"
        )
    array[..., 3:] /= length[..., None]
    return array


def compose(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """Compose two poses: returns a_from_c, given a_from_b and b_from_c."""
    outer, inner = np.broadcast_arrays(outer, inner)
    position = outer[..., :3] + rotate(outer[..., 3:], inner[..., :3])
    return np.concatenate([position, quaternion_multiply(outer[..., 3:], inner[..., 3:])], axis=-1)


def inverse(pose: np.ndarray) -> np.ndarray:
    """Invert a pose: returns b_from_a, given a_from_b."""
    back = pose[..., 3:] * [1.0, -1.0, -1.0, -1.0]
    return np.concatenate([-rotate(back, pose[..., :3]), back], axis=-1)


def rotate(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rotate points (..., 3) by unit quaternions (..., 4)."""
    w, axis = quaternion[..., :1], quaternion[..., 1:]
    across = 2 * np.cross(axis, points)
    return points + w * across + np.cross(axis, across)


def matrix_of(pose: np.ndarray) -> np.ndarray:
    """Matrices (..., 4, 4) of poses (..., 7)."""
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., :3, :3] = quaternion_to_matrix(pose[..., 3:])
    matrix[..., :3, 3] = pose[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def pose_of(matrix: np.ndarray) -> np.ndarray:
    """Pose (7,) of a rigid matrix (4, 4)."""
    return np.concatenate([matrix[:3, 3], matrix_to_quaternion(matrix[:3, :3])])


def _shown(array: np.ndarray, at: list[int]) -> str:
    return "(" + ", ".join(f"{number:g}" for number in array[tuple(at)].tolist()) + ")"
