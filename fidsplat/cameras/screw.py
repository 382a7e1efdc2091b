"""Rigid motions and their logarithms: the screw motion from one pose to another."""

import math

import numpy as np

from fidsplat.splats.rotations import matrix_to_quaternion


def between(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """The rigid pose (4, 4) at a share of the screw motion from one pose to another."""
    return start @ exponential(twist(start, end) * share)


def twist(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The twist (6,) of the screw motion that moves one rigid pose (4, 4) to another in time 1: axis times
    angle, and velocity, in the axes of `start`."""
    turn = start[:3, :3].T @ end[:3, :3]
    move = start[:3, :3].T @ (end[:3, 3] - start[:3, 3])
    axis = _rotation_vector(turn)
    # the velocity whose integral over the whole turn is `move`
    return np.concatenate([axis, np.linalg.solve(_integral(axis), move)])


def exponential(motion: np.ndarray) -> np.ndarray:
    """The rigid pose (4, 4) to which a twist (6,) takes the identity in time 1."""
    part = np.eye(4)
    part[:3, :3] = _turned(motion[:3])
    part[:3, 3] = _integral(motion[:3]) @ motion[3:]
    return part


def _skew(axis: np.ndarray) -> np.ndarray:
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _rotation_vector(turn: np.ndarray) -> np.ndarray:
    """Axis times angle (0 to pi) of a rotation matrix."""
    w, *xyz = matrix_to_quaternion(turn)
    length = np.linalg.norm(xyz)
    return np.array(xyz) * (2 * math.atan2(length, w) / length if length > 0 else 2.0)


def _turned(axis: np.ndarray) -> np.ndarray:
    """The rotation matrix of axis times angle."""
    angle, skew = float(np.linalg.norm(axis)), _skew(axis)
    half = np.sinc(angle / 2 / math.pi)
    return np.eye(3) + np.sinc(angle / math.pi) * skew + half * half / 2 * skew @ skew


def _integral(axis: np.ndarray) -> np.ndarray:
    """The integral over s in [0, 1] of the rotations by s times the axis."""
    angle, skew = float(np.linalg.norm(axis)), _skew(axis)
    half = np.sinc(angle / 2 / math.pi)
    third = 1 / 6 - angle**2 / 120 if angle < 1e-3 else (1 - np.sinc(angle / math.pi)) / angle**2
    return np.eye(3) + half * half / 2 * skew + third * skew @ skew
