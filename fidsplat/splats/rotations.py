"""Quaternions (w, x, y, z) and 4x4 rigid transforms, in float64."""

from typing import Any

import numpy as np

from fidsplat.util.arguments import LARGEST, real_array
from fidsplat.util.errors import InputError


def quaternion_multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product a b of quaternions (..., 4): rotate by b, then by a."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def quaternion_to_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) float64 of quaternions (..., 4) of any length but 0."""
    q = np.asarray(quaternion, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (4,) float64, w >= 0, of one rotation matrix (3, 3)."""
    outer = _outer_product(np.asarray(rotation, np.float64))
    row = outer[np.argmax(np.diag(outer))]
    row = row / np.linalg.norm(row)
    return row if row[0] >= 0 else -row


def matrices_to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) float64 of rotation matrices (..., 3, 3)."""
    outer = _outer_product(np.moveaxis(np.asarray(rotations, np.float64), (-2, -1), (0, 1)))
    largest = np.argmax(outer[range(4), range(4)], axis=0)
    rows = np.take_along_axis(outer, largest[None, None], 0)[0]
    w, x, y, z = rows
    return np.moveaxis(rows / np.sqrt(w * w + x * x + y * y + z * z), 0, -1)


def _outer_product(r: np.ndarray) -> np.ndarray:
    """4 q q^T (4, 4, ...) of rotation matrices (3, 3, ...); the row of its largest diagonal entry is parallel
    to q."""
    xx, yy, zz = r[0, 0], r[1, 1], r[2, 2]
    wx, wy, wz = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    xy, zx, yz = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    return np.array(
        [
            [1 + xx + yy + zz, wx, wy, wz],
            [wx, 1 + xx - yy - zz, xy, zx],
            [wy, xy, 1 - xx + yy - zz, yz],
            [wz, zx, yz, 1 - xx - yy + zz],
        ]
    )


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) nearest to a matrix (3, 3): orthogonal Procrustes problem."""
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def orthogonal_again(rotation: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) without the rounding of float32, by a Newton step: its error is squared."""
    return rotation @ (1.5 * np.eye(3) - 0.5 * rotation.T @ rotation)


def check_similarity(matrix, name: str, rigid: bool = False) -> tuple[np.ndarray, float, np.ndarray]:
    """Split a 4x4 similarity transform into rotation (3, 3), scale and translation (3,), float64.

    Raises InputError, with ``name``, for another matrix (within 1e-6), and with ``rigid`` for a scale other
    than 1.
    """
    m = real_array(name, matrix, "a 4x4 matrix of numbers")
    if m.shape != (4, 4):
        raise InputError(f"{name} must be a 4x4 matrix, got shape {m.shape}")
    if not (np.isfinite(m).all() and (np.abs(m[:3, 3]) <= LARGEST).all()):
        raise InputError(f"{name} must be finite, and move by at most {LARGEST:g} metres, got {m.tolist()}")
    if not np.array_equal(m[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{name} must have the last row (0, 0, 0, 1), got {tuple(m[3].tolist())}")
    linear = m[:3, :3]
    with np.errstate(over="ignore"):  # an overflow is rejected below
        scale = float(np.linalg.norm(linear)) / np.sqrt(3.0)
    if not scale > 0 or not np.isfinite(scale):
        raise InputError(f"{name} must be a rotation with a positive scale, got scale {scale:g}")
    rotation = linear / scale
    deviation = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if deviation > 1e-6:
        rounded = "; give more digits" if deviation < 0.01 else ""
        raise InputError(
            f"{name} must be a rotation with one uniform scale, got columns that are skew or of unequal "
            f"length, by {deviation:.1g} where 1e-06 is allowed{rounded}"
        )
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:  # the determinant
        raise InputError(f"{name} must be a rotation, got a reflection (its determinant is negative)")
    if rigid:
        if abs(scale - 1.0) > 1e-6:
            raise InputError(f"{name} must be rigid (rotation and translation), got scale {scale:g}")
        return linear, 1.0, m[:3, 3]
    return rotation, scale, m[:3, 3]


def pose_matrix(pose: Any, name: str) -> Any:
    """Convert a pose to a matrix. A pose is a 4x4 matrix, which is returned unchecked, a pair (position,
    quaternion w, x, y, z), or both in 7 numbers.

    Raises InputError, with ``name``, for a quaternion whose length is not 1 within 1e-3.
    """
    pair = isinstance(pose, tuple | list) and len(pose) == 2
    try:
        vector = not pair and np.shape(pose) == (7,)
    except (TypeError, ValueError):  # rows of unequal length
        vector = False
    if not (pair or vector):
        return pose
    what = f"position and quaternion of {name}"
    parts = [real_array(what, part) for part in (pose if pair else (pose[:3], pose[3:]))]
    if [part.shape for part in parts] != [(3,), (4,)] or not all(np.isfinite(part).all() for part in parts):
        raise InputError(
            f"{name} must be a 4x4 matrix, or a position (3,) and a quaternion (4,), got {pose!r}"
        )
    if abs(np.linalg.norm(parts[1]) - 1) > 1e-3:
        raise InputError(f"the quaternion w, x, y, z of {name} must have length 1, got {parts[1].tolist()}")
    return rigid_matrix(parts[0], parts[1])


def with_largest_component(three: np.ndarray, largest: np.ndarray) -> np.ndarray:
    """Unit quaternions (n, 4) of three components (n, 3) and the index (n,) of the fourth, which is >= 0."""
    quats = np.empty((len(three), 4))
    quats[np.arange(4) != largest[:, None]] = three.ravel()
    quats[np.arange(len(three)), largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(axis=1)))
    return quats


def rigid_matrix(position, quaternion=(1.0, 0.0, 0.0, 0.0), scale: float = 1.0) -> np.ndarray:
    """4x4 float64 matrix: scale, then rotation by a quaternion (w, x, y, z) of any length but 0, then
    translation."""
    translation, rotation = real_array("position", position), real_array("quaternion", quaternion)
    if translation.shape != (3,) or not np.isfinite(translation).all():
        raise InputError(f"position must be three finite numbers, got {position!r}")
    with np.errstate(over="ignore"):  # an overflow is rejected below
        length = np.linalg.norm(rotation) if rotation.shape == (4,) else np.nan
    if not (0 < length < np.inf):
        raise InputError(
            f"quaternion must be four finite numbers (w, x, y, z), not all 0, got {quaternion!r}"
        )
    if not (0 < scale < np.inf):
        raise InputError(f"scale must be above 0 and finite, got {scale!r}")
    matrix = np.eye(4)
    matrix[:3, :3] = scale * quaternion_to_matrix(rotation)
    matrix[:3, 3] = translation
    return matrix
