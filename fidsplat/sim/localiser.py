"""Where a robot on a floor is: by an error-state filter of wheels, a gyroscope and tags in known places."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.rotations import rigid_matrix

GATE = 4.0
"""standard deviations by which a tag's corners may be off before it is not believed"""
TIPPING = 0.005, 0.005, 0.003
"""radians of roll and pitch, metres of height: standard deviations of what the state does not have"""
_STEP = 1e-5
"""metres and radians, of derivatives"""


class Localiser:
    """State: x, y [m] and heading [rad] of the robot, the gyroscope's bias [rad/s], the wheels' common scale.

    Wheels say how far, the gyroscope how much it turns; corners of tags in a picture correct all of it. Of
    the error state the covariance is kept; a correction is added to the state at once.

    Args:
        start: x, y, heading.
        corner_noise: pixels, standard deviation of a detected corner.
    """

    def __init__(self, start: np.ndarray, corner_noise: float = 0.5) -> None:
        self.state = np.array([*start, 0.0, 1.0])
        self._noise = corner_noise
        self.covariance = np.diag([0.01, 0.01, 0.01, 0.005, 0.02]) ** 2
        self.refused = 0
        """tags that were not believed"""

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) world from robot."""
        return _pose(self.state)

    def move(self, wheels: np.ndarray, gyro: float, seconds: float) -> None:
        """What wheels (2,) [m] and gyroscope [rad/s] have measured since the last call."""
        rolled = float(wheels.mean())
        heading, bias, scale = self.state[2:]
        turned = (gyro - bias) * seconds
        middle, distance = heading + turned / 2, scale * rolled
        cos, sin = math.cos(middle), math.sin(middle)
        self.state[:3] += [distance * cos, distance * sin, turned]
        by = np.eye(5)
        by[0, 2:] = -distance * sin, distance * sin * seconds / 2, rolled * cos
        by[1, 2:] = distance * cos, -distance * cos * seconds / 2, rolled * sin
        by[2, 3] = -seconds
        slip, turn = 0.003**2 * abs(rolled), (0.003 * seconds) ** 2 + 1e-6 * abs(rolled)
        added = np.diag([slip, slip, turn, 1e-10 * seconds, 1e-9 * abs(rolled)])
        self.covariance = by @ self.covariance @ by.T + added

    def see(self, corners: np.ndarray, tag: np.ndarray, camera: Callable[[np.ndarray], Camera]) -> bool:
        """Correct by a tag. Returns whether it was believed.

        Args:
            corners: (4, 2) pixels.
            tag: (4, 3) metres, where its corners are in the world.
            camera: the camera where it stands when the robot stands at (4, 4).
        """
        here = self.pose
        seen = camera(here).project(tag)

        def derivative(moved: np.ndarray) -> np.ndarray:
            return (camera(moved).project(tag) - seen).ravel() / _STEP

        by = np.zeros((8, 5))
        for k in range(3):
            state = self.state.copy()
            state[k] += _STEP
            by[:, k] = derivative(_pose(state))
        tipped = np.array([derivative(here @ _tip(k)) for k in range(3)]) * np.array(TIPPING)[:, None]
        off = (corners - seen).ravel()
        if not (np.isfinite(off).all() and np.isfinite(by).all() and np.isfinite(tipped).all()):
            return False
        noise = self._noise**2 * np.eye(8) + tipped.T @ tipped
        spread = by @ self.covariance @ by.T + noise
        if off @ np.linalg.solve(spread, off) > GATE**2 * 8:
            self.refused += 1
            return False
        gain = np.linalg.solve(spread, by @ self.covariance).T
        self.state += gain @ off
        kept = np.eye(5) - gain @ by
        self.covariance = kept @ self.covariance @ kept.T + gain @ noise @ gain.T
        return True


def _pose(state: np.ndarray) -> np.ndarray:
    x, y, heading = state[:3]
    return rigid_matrix((x, y, 0.0), (math.cos(heading / 2), 0, 0, math.sin(heading / 2)))


def _tip(axis: int) -> np.ndarray:
    """A little roll, pitch or rise."""
    quaternion = [1.0, 0.0, 0.0, 0.0]
    if axis == 2:
        return rigid_matrix((0, 0, _STEP))
    quaternion[1 + axis] = _STEP / 2
    return rigid_matrix((0, 0, 0), quaternion)
