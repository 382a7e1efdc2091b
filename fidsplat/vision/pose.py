"""Pose of a marker from its corners in an image (PnP)."""

import math

import cv2
import numpy as np

from fidsplat.cameras import Camera
from fidsplat.util.arguments import LARGEST, instance, real_array
from fidsplat.util.errors import InputError

# OpenCV's marker frame has y up and z towards the viewer, ours y down and z away (docs/conventions.md)
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])

SAME = 1e-6
"""Minimum improvement in pixels for the second pose to replace the first."""

LOOSE = 0.1
"""Tolerance of the plane that replaces points, relative to their spread."""

SMALLEST = 1e-9
"""Minimum edge of a code in metres."""


def marker_pose(corners: np.ndarray, size: float, camera: Camera) -> np.ndarray:
    """Estimate camera_from_marker, (4, 4) float64, in metres.

    IPPE (Collins and Bartoli 2014) has two solutions for a nearly ambiguous square; Levenberg-Marquardt
    minimizes the reprojection error of both, and the pose with the lower error is returned. NaN if neither is
    in front of the camera, or if corners coincide.

    Args:
        corners: (4, 2) pixels, TL, TR, BR, BL as printed.
        size: edge of the code in metres.
        camera: its intrinsics and lens are used, not its pose.

    Raises:
        InputError: corners of another shape, a size of 0 or less, or an orthographic camera, where the
            distance of a marker is undetermined.
    """
    corners, edge = real_array("corners", corners), real_array("size", size)
    if corners.shape != (4, 2):
        raise InputError(f"corners must be (4, 2) pixels, got {corners.shape}")
    if edge.shape != () or not SMALLEST <= edge < LARGEST:
        raise InputError(f"size must be a positive length in metres, {SMALLEST:g} or more, got {size!r}")
    instance("camera", camera, Camera)
    half = float(edge) / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], np.float64)
    return _pose(square, corners, camera, cv2.SOLVEPNP_IPPE_SQUARE)


def plane_pose(points: np.ndarray, corners: np.ndarray, camera: Camera) -> np.ndarray:
    """Estimate camera_from_marker from coplanar points by IPPE.

    points: (n, 2) metres on the marker, x right, y down as printed; four or more that are not collinear.
    corners: (n, 2) pixels.
    """
    return _pose(
        np.column_stack([points * [1, -1], np.zeros(len(points))]), corners, camera, cv2.SOLVEPNP_IPPE
    )


def points_pose(points: np.ndarray, corners: np.ndarray, camera: Camera) -> np.ndarray:
    """Estimate the pose of a rigid body from four or more points, (n, 3) metres and (n, 2) pixels.

    SQPnP (Terzakis and Lourakis 2020) computes the initial poses.
    """
    return _pose(points * [1, -1, -1], corners, camera, cv2.SOLVEPNP_SQPNP)


def _pose(points: np.ndarray, corners: np.ndarray, camera: Camera, method: int) -> np.ndarray:
    """Estimate camera_from_marker from points (n, 3) in OpenCV's axes."""
    observed, matrix, rotated = np.ascontiguousarray(corners, np.float64), camera.matrix, np.eye(4)
    if camera.lens is not None:
        observed, matrix, rotated = _undistorted(observed, camera)
    if not np.isfinite(observed).all():
        return np.full((4, 4), np.nan)
    best, smallest = np.full((4, 4), np.nan), math.inf
    spread = float(np.linalg.norm(observed - observed.mean(0)))
    # OpenCV's IPPE divides by almost 0 for a frontal marker: its poses can be NaN or arbitrary
    for way in dict.fromkeys((method, cv2.SOLVEPNP_SQPNP)):
        try:
            count, rotations, translations, _ = cv2.solvePnPGeneric(points, observed, matrix, None, flags=way)
        except cv2.error:  # corners that coincide
            continue
        for rotation, translation in zip(rotations[:count], translations[:count], strict=True):
            rotation, translation = cv2.solvePnPRefineLM(
                points, observed, matrix, None, rotation, translation
            )
            projected, _ = cv2.projectPoints(points, rotation, translation, matrix, None)
            error = float(np.linalg.norm(projected.reshape(-1, 2) - observed))
            fits = way == method or error < LOOSE * spread
            if fits and error < smallest - SAME and translation[2, 0] > 0:
                smallest, best = error, np.eye(4)
                best[:3, :3], best[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return rotated @ best @ _FLIP


def _undistorted(corners: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Undistort corners to a pinhole that looks at their centre; returns corners, intrinsics and
    camera_from_pinhole (4, 4)."""
    rays = camera.rays(corners)
    axis = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).sum(0)
    axis /= np.linalg.norm(axis)
    side = np.cross([0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [0.0, 0.0, 1.0], axis)
    side /= np.linalg.norm(side)
    rotated = np.eye(4)
    rotated[:3, :3] = np.stack([side, np.cross(axis, side), axis], axis=1)
    flat = rays @ rotated[:3, :3]
    matrix = np.diag([camera.fx, camera.fx, 1.0])
    return np.ascontiguousarray(camera.fx * flat[:, :2] / flat[:, 2:]), matrix, rotated


def pose_error(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance in metres and angle in radians between two rigid poses (4, 4)."""
    distance = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    delta = estimate[:3, :3].T @ truth[:3, :3]
    sine = (
        np.linalg.norm([delta[2, 1] - delta[1, 2], delta[0, 2] - delta[2, 0], delta[1, 0] - delta[0, 1]]) / 2
    )
    return distance, math.atan2(float(sine), (float(np.trace(delta)) - 1) / 2)
