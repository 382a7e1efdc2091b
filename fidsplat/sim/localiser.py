"""Error-state Kalman filter for a robot on a floor, from wheel odometry, a gyroscope, tags of known pose and
LiDAR scans."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.rotations import rigid_matrix

GATE = 4.0
"""outlier threshold: maximum residual of a tag's corners in standard deviations"""
TILT = 0.005, 0.005, 0.003
"""standard deviations of roll and pitch [rad] and height [m], which are not part of the state"""
_STEP = 1e-5
"""step of numerical derivatives, metres and radians"""


class Localiser:
    """Error-state Kalman filter of a robot's pose.

    State: x, y [m] and heading [rad] of the robot, bias of the gyroscope [rad/s], common scale of the wheels.

    Wheels measure the distance, the gyroscope the rotation; corners of tags in an image and matches of scans
    correct the pose. The filter stores the covariance of the error state; a correction is added to the state
    at once. A scan is matched to an earlier one, the reference, whose pose is part of the error state
    (stochastic cloning), since the errors of both poses are correlated.

    Args:
        start: x, y, heading.
        corner_noise: pixels, standard deviation of a detected corner.
        drift: standard deviation of the position after a second in addition to that of the wheels, metres.
        bias: standard deviation of the bias of the gyroscope at the start, radians per second.
        bias_walk: standard deviation of the change of the bias after a second.
    """

    def __init__(
        self,
        start: np.ndarray,
        corner_noise: float = 0.5,
        drift: float = 0.0,
        bias: float = 0.005,
        bias_walk: float = 1e-5,
    ) -> None:
        self.state = np.array([*start, 0.0, 1.0])
        self._noise, self._drift, self._bias_walk = corner_noise, drift, bias_walk
        self.covariance = np.diag([0.01, 0.01, 0.01, bias, 0.02]) ** 2
        self._reference, self._reference_is_new = self.state[:3].copy(), False
        self.rejected = 0
        """number of tags and scans rejected as outliers"""

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) world from robot."""
        return _pose(self.state)

    @property
    def relative(self) -> np.ndarray:
        """(4, 4) pose of the robot relative to its pose at the reference scan."""
        return np.linalg.inv(_pose(self._reference)) @ self.pose

    def move(self, wheels: np.ndarray, gyro: float, seconds: float) -> None:
        """Predict the state from readings of wheels (2,) [m] and gyroscope [rad/s] over some seconds."""
        rolled = float(wheels.mean())
        heading, bias, scale = self.state[2:]
        rotation = (gyro - bias) * seconds
        middle, distance = heading + rotation / 2, scale * rolled
        cos, sin = math.cos(middle), math.sin(middle)
        self.state[:3] += [distance * cos, distance * sin, rotation]
        transition = np.eye(len(self.covariance))
        transition[0, 2:5] = -distance * sin, distance * sin * seconds / 2, rolled * cos
        transition[1, 2:5] = distance * cos, -distance * cos * seconds / 2, rolled * sin
        transition[2, 3] = -seconds
        slip, rotation_variance = 0.003**2 * abs(rolled), (0.003 * seconds) ** 2 + 1e-6 * abs(rolled)
        slip += self._drift**2 * seconds
        walk = self._bias_walk**2 * seconds
        self.covariance = transition @ self.covariance @ transition.T
        self.covariance[range(5), range(5)] += slip, slip, rotation_variance, walk, 1e-9 * abs(rolled)

    def set_reference(self) -> None:
        """Set the pose of the reference scan to the current pose."""
        clone = np.vstack([np.eye(5), np.eye(3, 5)])
        self.covariance = clone @ self.covariance[:5, :5] @ clone.T
        self._reference, self._reference_is_new = self.state[:3].copy(), True

    def match(self, relative: np.ndarray, noise: np.ndarray) -> bool:
        """Correct the state by a matched scan; returns False if the match was rejected.

        Args:
            relative: (3,) measured x, y and heading of the robot in its pose at the reference scan.
            noise: (3, 3) covariance of the measurement, of which each of the two scans has half.
        """
        expected, heading = self.relative, self._reference[2]
        back = np.eye(3)
        back[:2, :2] = [[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]]
        if self._reference_is_new:  # its error is common to all matches with it
            self.covariance[5:, 5:] += back.T @ noise @ back / 2
            self._reference_is_new = False
        by = np.zeros((3, 8))
        by[:, :3], by[:, 5:] = back, -back
        by[:2, 7] = expected[1, 3], -expected[0, 3]
        off = relative - [*expected[:2, 3], self.state[2] - heading]
        off[2] = math.remainder(off[2], math.tau)
        return self._correct(off, by, noise / 2)

    def correct(self, corners: np.ndarray, tag: np.ndarray, camera: Callable[[np.ndarray], Camera]) -> bool:
        """Correct the state by a detected tag; returns False if the tag was rejected.

        Args:
            corners: (4, 2) pixels.
            tag: (4, 3) metres, the tag's corners in the world.
            camera: returns the camera for a robot pose (4, 4).
        """
        here = self.pose
        projected = camera(here).project(tag)

        def derivative(moved: np.ndarray) -> np.ndarray:
            return (camera(moved).project(tag) - projected).ravel() / _STEP

        by = np.zeros((8, len(self.covariance)))
        for k in range(3):
            state = self.state.copy()
            state[k] += _STEP
            by[:, k] = derivative(_pose(state))
        tilted = np.array([derivative(here @ _tilt(k)) for k in range(3)]) * np.array(TILT)[:, None]
        off = (corners - projected).ravel()
        if not (np.isfinite(off).all() and np.isfinite(by).all() and np.isfinite(tilted).all()):
            return False
        return self._correct(off, by, self._noise**2 * np.eye(8) + tilted.T @ tilted)

    def _correct(self, off: np.ndarray, by: np.ndarray, noise: np.ndarray) -> bool:
        """Correct the state by a residual with its derivative and noise, unless it is an outlier."""
        spread = by @ self.covariance @ by.T + noise
        if off @ np.linalg.solve(spread, off) > GATE**2 * len(off):
            self.rejected += 1
            return False
        gain = np.linalg.solve(spread, by @ self.covariance).T
        change = gain @ off
        self.state += change[:5]
        self._reference += change[5:] if len(change) > 5 else 0.0
        reduction = np.eye(len(self.covariance)) - gain @ by
        self.covariance = reduction @ self.covariance @ reduction.T + gain @ noise @ gain.T
        return True


def _pose(state: np.ndarray) -> np.ndarray:
    x, y, heading = state[:3]
    return rigid_matrix((x, y, 0.0), (math.cos(heading / 2), 0, 0, math.sin(heading / 2)))


def _tilt(axis: int) -> np.ndarray:
    """Rigid matrix of a roll (0) or pitch (1) by `_STEP` radians, or of a rise (2) by `_STEP` metres."""
    quaternion = [1.0, 0.0, 0.0, 0.0]
    if axis == 2:
        return rigid_matrix((0, 0, _STEP))
    quaternion[1 + axis] = _STEP / 2
    return rigid_matrix((0, 0, 0), quaternion)
