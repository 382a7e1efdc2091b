"""Scan matching by generalised ICP: the motion of a robot on a floor between two LiDAR scans."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fidsplat.sim.localiser import TILT, Localiser
from fidsplat.util.errors import required_package

with required_package("small_gicp", "sim"):
    import small_gicp

KEY_DISTANCE, KEY_TURN = 1.0, 0.5
"""metres and radians from a reference scan to the next"""
VOXEL = 0.08
"""metres: points are averaged over cubes of this edge"""
NEIGHBOURS = 10
"""points that determine the plane of a point"""
MINIMUM = 20
"""smallest number of averaged points of a scan; small_gicp crashes without points"""
REACH = 0.15
"""metres: longest distance between corresponding points"""
FLOOR = 0.2
"""metres: lower points are ignored, since rings on a floor move with the sensor"""


class ScanMatcher:
    """Scan matcher that corrects a localiser by the motion since a reference scan, which is replaced as the
    robot moves.

    height: height of the LiDAR above the floor [m], over the middle of the axle; it moves with the robot's
    tilt.
    """

    def __init__(self, height: float) -> None:
        self._reference: tuple[Any, Any] | None = None
        self._height = height
        self._sway = np.diag([height * TILT[1], height * TILT[0], 1e-3]) ** 2

    def correct(self, localiser: Localiser, points: np.ndarray) -> bool:
        """Correct a localiser by the points (n, 3) of a scan in the frame of the LiDAR, whose axes are those
        of the robot; returns whether they matched the reference scan. Scans of fewer points than `MINIMUM`
        have no effect."""
        points, matched = np.asarray(points, np.float64), False
        above = np.isfinite(points).all(1) & (points[:, 2] > FLOOR - self._height)
        scan = small_gicp.preprocess_points(points[above], VOXEL, NEIGHBOURS)
        if scan[0].size() < MINIMUM:
            return False
        if self._reference is not None:
            alignment = self._match(scan[0], localiser.relative)
            matched = alignment is not None and localiser.match(*alignment)
        moved = localiser.relative
        near = np.linalg.norm(moved[:2, 3]) < KEY_DISTANCE and moved[0, 0] > math.cos(KEY_TURN)
        if self._reference is None or not near:
            self._reference = scan
            localiser.set_reference()
        return matched

    def _match(self, scan: Any, start: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """x, y, heading (3,) of a scan in the reference scan and their covariance (3, 3); None without
        convergence."""
        assert self._reference is not None
        alignment = small_gicp.align(
            self._reference[0], scan, self._reference[1], start, registration_type="GICP",
            max_correspondence_distance=REACH, max_iterations=30,
        )  # fmt: skip
        if not alignment.converged or alignment.num_inliers < MINIMUM:
            return None
        pose = alignment.T_target_source
        # the error is a small motion of the scan in its own axes: rotation, then translation
        axes = np.eye(3)
        axes[:2, :2] = pose[:2, :2]
        # residuals of points are correlated whose neighbourhoods overlap: within twice their radius
        variance = 4 * NEIGHBOURS * 2 * alignment.error / alignment.num_inliers
        inverse = np.linalg.inv(_information(alignment, scan.points()[:, :3]))[np.ix_([3, 4, 2], [3, 4, 2])]
        noise = variance * axes @ inverse @ axes.T + 2 * self._sway
        return np.array([*pose[:2, 3], math.atan2(pose[1, 0], pose[0, 0])]), noise


def _information(found: Any, points: np.ndarray) -> np.ndarray:
    """Hessian (6, 6) of a match without information along the planes of points, such as in a corridor.

    The Hessian has a spurious value of 1/2 for each point along its plane, as the Gaussians of points are
    truncated, and about as much by noise of the normals.
    """
    derivatives = np.cross(points[:, None], np.eye(3)).swapaxes(1, 2)
    by = np.concatenate([derivatives, np.broadcast_to(-np.eye(3), derivatives.shape)], 2)
    along = np.einsum("nki,nkj->ij", by, by) * found.num_inliers / len(points)
    values, vectors = np.linalg.eigh(found.H - along)
    return vectors * np.maximum(values, 1e-8 * values[-1]) @ vectors.T
