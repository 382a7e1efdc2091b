"""Scan matching by point-to-plane ICP: the motion of a robot on a floor between two LiDAR scans."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fidsplat.sim.localiser import TILT, Localiser
from fidsplat.util.errors import InputError

try:
    import small_gicp
except ImportError as error:
    raise InputError(f"scan matching needs another package ({error}); pip install 'fidsplat[sim]'") from None

KEY_DISTANCE, KEY_TURN = 1.0, 0.5
"""metres and radians from a reference scan to the next"""
VOXEL = 0.08
"""metres: points are averaged over cubes of this edge"""
MINIMUM = 20
"""smallest number of averaged points of a scan; small_gicp crashes without points"""
REACH = 0.3
"""metres: longest distance between corresponding points"""
SPREAD = 0.6
"""metres: standard deviation of the distance of a point to its plane, of which the covariance of a match
follows; larger than the residuals, since errors of neighbours and of scans with one reference are
correlated"""


class ScanMatcher:
    """Corrects a localiser by the motion since a reference scan, which is replaced as the robot moves on.

    height: metres of the LiDAR above the floor, over the middle of the axle; it sways with the tilt of the
    robot.
    """

    def __init__(self, height: float) -> None:
        self._reference: tuple[Any, Any] | None = None
        self._sway = np.diag([height * TILT[1], height * TILT[0], 1e-3]) ** 2

    def correct(self, localiser: Localiser, points: np.ndarray) -> bool:
        """Correct a localiser by the points (n, 3) of a scan in the axes of the robot; returns whether they
        matched the reference scan. Scans of fewer points than `MINIMUM` have no effect."""
        points, matched = np.asarray(points, np.float64), False
        scan = small_gicp.preprocess_points(points[np.isfinite(points).all(1)], VOXEL, 10)
        if scan[0].size() < MINIMUM:
            return False
        if self._reference is not None:
            found = self._match(scan[0], localiser.relative)
            matched = found is not None and localiser.match(*found)
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
        found = small_gicp.align(
            self._reference[0], scan, self._reference[1], start, registration_type="PLANE_ICP",
            max_correspondence_distance=REACH, max_iterations=30,
        )  # fmt: skip
        if not found.converged or np.linalg.cond(found.H) > 1e12:
            return None
        pose = found.T_target_source
        # the error is a small motion of the scan in its own axes: rotation, then translation
        axes = np.eye(3)
        axes[:2, :2] = pose[:2, :2]
        noise = SPREAD**2 * axes @ np.linalg.inv(found.H)[np.ix_([3, 4, 2], [3, 4, 2])] @ axes.T
        return np.array([*pose[:2, 3], math.atan2(pose[1, 0], pose[0, 0])]), noise + self._sway
