"""Trajectories: poses as functions of time, interpolated between keyframes."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.cameras.screw import exponential, interpolate, twist
from fidsplat.splats.rotations import check_similarity, matrix_to_quaternion, pose_matrix, rigid_matrix
from fidsplat.util.arguments import PickledByFields, as_float, flag, invalid, number, real_array
from fidsplat.util.errors import InputError

MAX_LENGTH_ERROR = 1e-3
"""largest deviation of a quaternion's length from 1, for quaternions that files round"""
MAX_SAMPLES = 10_000_000
"""maximum number of sampled poses"""


@dataclass(frozen=True, eq=False)
class Trajectory(PickledByFields):
    """Pose as a function of time in seconds, interpolated between keyframes along screw motions (geodesics of
    SE(3)); constant before the first and after the last keyframe.

    Trajectory files contain camera-to-world poses; `Motion.camera` is world to camera, the `inverse()`.
    Raises InputError for times that do not increase, and for poses that are not rigid.
    """

    times: Sequence[float] | np.ndarray
    """(k,) seconds, increasing"""
    poses: np.ndarray
    """(k, 4, 4) rigid; or given as pairs of a position and a unit quaternion w, x, y, z, or as (k, 7)"""
    smooth: bool = False
    """continuous velocity: a cubic Bezier curve of screw motions between keyframes. The velocity at a
    keyframe is the slope of the parabola through it and its neighbours, limited for fast rotations.
    Keyframes must be less than half a rotation apart"""

    def __post_init__(self) -> None:
        times = real_array("the times of a trajectory", self.times, "increasing numbers of seconds")
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise InputError(
                "the times of a trajectory must be one or more finite, increasing numbers of seconds, got "
                f"{_offending_times(self.times, times)}"
            )
        count = len(self.poses) if isinstance(self.poses, Sequence) or np.ndim(self.poses) else 0
        if count != len(times):
            raise InputError(f"a trajectory must have one pose for each of {len(times)} times, got {count}")
        flag("smooth", self.smooth)
        first = self.poses[0]
        if isinstance(first, Sequence | np.ndarray) and len(first) == 7:
            poses = np.array([_of_vector(k, vector) for k, vector in enumerate(self.poses)])
        else:
            matrices = [pose_matrix(pose, f"pose {k} of a trajectory") for k, pose in enumerate(self.poses)]
            for k, pose in enumerate(matrices):
                check_similarity(pose, f"pose {k} of a trajectory", rigid=True)
            poses = np.array(matrices, np.float64)
        times.flags.writeable = poses.flags.writeable = False
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "poses", poses)

    def __len__(self) -> int:
        return len(self.poses)

    def __repr__(self) -> str:
        first, last = float(self.times[0]), float(self.times[-1])
        kind = "smooth" if self.smooth else "screw motions"
        return f"Trajectory({len(self)} poses, {first:g} to {last:g} s, {kind})"

    def __call__(self, time: float) -> np.ndarray:
        """Pose (4, 4) float64 at a time in seconds. Raises InputError for a time that is not finite."""
        time = number("the time of a trajectory", time)
        times = np.asarray(self.times)
        after = int(np.searchsorted(times, time, side="right"))
        if after == 0 or after == len(times):
            return self.poses[min(after, len(times) - 1)]
        start, end, duration = self.poses[after - 1], self.poses[after], times[after] - times[after - 1]
        fraction = float((time - times[after - 1]) / duration)
        if not self.smooth:
            return interpolate(start, end, fraction)
        curve = [start, start @ exponential(self._velocities[after - 1] * (duration / 3))]
        curve += [end @ exponential(self._velocities[after] * (-duration / 3)), end]
        while len(curve) > 1:  # de Casteljau's algorithm with screw motions instead of lines
            curve = [interpolate(a, b, fraction) for a, b in itertools.pairwise(curve)]
        return curve[0]

    @cached_property
    def _velocities(self) -> np.ndarray:
        """(k, 6) twists per second at the keyframes, in the axes of each keyframe."""
        durations = np.diff(self.times)[:, None]
        if not len(durations):
            return np.zeros((1, 6))
        velocities = np.array([twist(*pair) for pair in itertools.pairwise(self.poses)]) / durations
        before, after = durations[:-1], durations[1:]
        inner = (velocities[:-1] * after + velocities[1:] * before) / (before + after)
        # limits rotations: a third of an interval's velocity must rotate by less than a quarter rotation,
        # otherwise a fast rotation in a short interval makes the long neighbour's curve ambiguous
        rotations = np.linalg.norm(inner[:, :3], axis=1, keepdims=True) * np.maximum(before, after) / 3
        inner *= np.minimum(1.0, math.pi / 2 / np.maximum(rotations, 1e-300))
        return np.concatenate([velocities[:1], inner, velocities[-1:]])

    @property
    def vectors(self) -> np.ndarray:
        """(k, 7) float64: the poses as x, y, z in metres and unit quaternions w, x, y, z, w >= 0."""
        return np.array([[*pose[:3, 3], *matrix_to_quaternion(pose[:3, :3])] for pose in self.poses])

    def inverse(self) -> Trajectory:
        """Trajectory of the inverse poses: world to camera from camera to world, and vice versa."""
        rotations = self.poses[:, :3, :3].transpose(0, 2, 1)
        poses = np.zeros_like(self.poses)
        poses[:, :3, :3], poses[:, 3, 3] = rotations, 1.0
        poses[:, :3, 3] = -(rotations @ self.poses[:, :3, 3:])[:, :, 0]
        return Trajectory(self.times, poses, self.smooth)

    def sampled(self, rate: float) -> Trajectory:
        """Poses at a rate per second, from the first keyframe to the last; at most 10 million."""
        check_rate(rate)
        first, last = float(self.times[0]), float(self.times[-1])
        steps = (last - first) * float(rate)
        if steps >= MAX_SAMPLES:
            raise InputError(
                f"a trajectory must have at most {MAX_SAMPLES:,} poses, got {rate:g} per second over "
                f"{last - first:g} s; give a lower rate"
            )
        # 1e-6: the end is included if it is a multiple of 1 / rate
        times = first + np.arange(int(steps + 1e-6) + 1) / rate
        return Trajectory(times, np.array([self(time) for time in times]))


def check_rate(rate: float) -> None:
    """Raise InputError for a rate that is not a number of poses per second above 0."""
    if not 0 < as_float(rate) < math.inf:
        raise invalid("the rate", "a number of poses per second above 0", rate)


def _of_vector(k: int, vector) -> np.ndarray:
    """Matrix of pose k, given as x, y, z and a unit quaternion w, x, y, z."""
    numbers = real_array(f"pose {k} of a trajectory", vector, "x, y, z and a quaternion w, x, y, z")
    if numbers.shape != (7,) or not np.isfinite(numbers).all():
        raise InputError(
            f"pose {k} of a trajectory must be 7 finite numbers, x, y, z and a quaternion w, x, y, z, got "
            f"{numbers.tolist()}"
        )
    length = float(np.linalg.norm(numbers[3:]))
    if abs(length - 1) > MAX_LENGTH_ERROR:
        raise InputError(
            f"the quaternion w, x, y, z of pose {k} of a trajectory must have length 1, got {length:g} for "
            f"{numbers[3:].tolist()}"
        )
    return rigid_matrix(numbers[:3], numbers[3:])


def _offending_times(original, times: np.ndarray) -> str:
    """The times for an error message: the first pair that does not increase, or all times."""
    if times.ndim == 1 and len(times) > 1 and np.isfinite(times).all():
        k = int(np.argmax(np.diff(times) <= 0))
        return f"{times[k]:.15g} and then {times[k + 1]:.15g} (number {k + 1}, counted from 0)"
    return repr(original)
