"""Screw motions between rigid poses: exponential and logarithm of SE(3)."""

import math

import numpy as np

from fidsplat.splats.rotations import matrix_to_quaternion


def interpolate(start: np.ndarray, end: np.ndarray, fraction: float) -> np.ndarray:
    """Interpolate along the screw motion from one rigid pose (4, 4) to another. fraction: 0 to 1."""
    return start @ exponential(twist(start, end) * fraction)


def twist(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Logarithm of SE(3): the twist (6,) from one rigid pose (4, 4) to another in time 1: rotation vector
    [rad], then velocity, in the axes of `start`."""
    rotation = start[:3, :3].T @ end[:3, :3]
    translation = start[:3, :3].T @ (end[:3, 3] - start[:3, 3])
    axis = _rotation_vector(rotation)
    # the velocity that integrates to `translation` over the complete rotation
    return np.concatenate([axis, np.linalg.solve(_left_jacobian(axis), translation)])


def exponential(motion: np.ndarray) -> np.ndarray:
    """Exponential of SE(3): the rigid motion (4, 4) of a twist (6,) in time 1."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(motion[:3])
    pose[:3, 3] = _left_jacobian(motion[:3]) @ motion[3:]
    return pose


def _skew(axis: np.ndarray) -> np.ndarray:
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Axis times angle (0 to pi) of a rotation matrix."""
    w, *xyz = matrix_to_quaternion(rotation)
    sine = np.linalg.norm(xyz)
    return np.array(xyz) * (2 * math.atan2(sine, w) / sine if sine > 0 else 2.0)


def rotation_matrix(axis: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector (3,), axis times angle in radians (Rodrigues)."""
    angle, skew = float(np.linalg.norm(axis)), _skew(axis)
    half_sinc = np.sinc(angle / 2 / math.pi)
    return np.eye(3) + np.sinc(angle / math.pi) * skew + half_sinc * half_sinc / 2 * skew @ skew


def _left_jacobian(axis: np.ndarray) -> np.ndarray:
    """Left Jacobian (3, 3) of SO(3) at a rotation vector v: integral of exp(s [v]x) over s from 0 to 1."""
    angle, skew = float(np.linalg.norm(axis)), _skew(axis)
    half_sinc = np.sinc(angle / 2 / math.pi)
    cubic = 1 / 6 - angle**2 / 120 if angle < 1e-3 else (1 - np.sinc(angle / math.pi)) / angle**2
    return np.eye(3) + half_sinc * half_sinc / 2 * skew + cubic * skew @ skew
