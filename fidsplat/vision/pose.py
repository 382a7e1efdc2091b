"""Where a square code is, from its four corners in a picture."""

import math

import cv2
import numpy as np

from fidsplat.cameras import Camera

# OpenCV's square has y up and z towards the viewer, ours y down and z away (docs/conventions.md)
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def marker_pose(corners: np.ndarray, size: float, camera: Camera) -> np.ndarray:
    """camera_from_marker, (4, 4) float64, metres.

    IPPE (Collins and Bartoli 2014) gives the two poses that a square can nearly be confused between; both are
    settled by Levenberg-Marquardt on the reprojection error and the one with the lower error is returned.

    Args:
        corners: (4, 2) pixels, TL, TR, BR, BL as printed.
        size: edge of the code in metres.
        camera: its intrinsics are used, not its pose.
    """
    half = size / 2
    square = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]], np.float64)
    seen = np.ascontiguousarray(corners, np.float64)
    count, turns, moves, _ = cv2.solvePnPGeneric(
        square, seen, camera.matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    best, least = np.full((4, 4), np.nan), math.inf
    for turn, move in zip(turns[:count], moves[:count], strict=True):
        turn, move = cv2.solvePnPRefineLM(square, seen, camera.matrix, None, turn, move)
        drawn, _ = cv2.projectPoints(square, turn, move, camera.matrix, None)
        error = float(np.linalg.norm(drawn.reshape(4, 2) - seen))
        if error < least and move[2, 0] > 0:
            least, best = error, np.eye(4)
            best[:3, :3], best[:3, 3] = cv2.Rodrigues(turn)[0], move[:, 0]
    return best @ _FLIP


def pose_error(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance in metres and angle in radians between two rigid poses (4, 4)."""
    apart = float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3]))
    turn = estimate[:3, :3].T @ truth[:3, :3]
    # the arc tangent keeps small angles that the arc cosine of the trace would round away
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    return apart, math.atan2(float(sine), (float(np.trace(turn)) - 1) / 2)
