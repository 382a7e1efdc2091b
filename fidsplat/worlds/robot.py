"""Simulated drive of a differential-drive robot in MuJoCo, with wheel odometry and a gyroscope."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Trajectory
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError, required_package

WHEEL, TRACK = 0.08, 0.3
"""metres: radius of a wheel, distance between the wheels"""
CAMERA_AT = (0.1, 0.0, 0.32)
"""metres from the middle of the axle on the floor; the camera faces forward"""
LIDAR_AT = (0.0, 0.0, 0.7)
"""metres from the middle of the axle on the floor; the LiDAR has the axes of the robot"""
CONTROL = 0.02
"""seconds between commands, and between sensor readings"""
MAX_ACCELERATION = 0.5
"""metres per second squared"""
MAX_TURN_RATE = 1.2
"""radians per second"""

# Casters are frictionless spheres: MuJoCo uses the larger friction of a contact, so they need condim 1.
# Wheels are ellipsoids, since flat ones scrub when the robot turns.
BODY = f"""    <body name="robot" pos="0 0 {WHEEL}">
      <freejoint/>
      <geom type="box" size="0.16 0.1 0.05" pos="0 0 0.06" mass="4"/>
      <geom type="sphere" size="0.04" pos="-0.13 0 {0.04 - WHEEL}" condim="1" priority="1" mass="0.2"/>
      <geom type="sphere" size="0.04" pos="0.13 0 {0.04 - WHEEL}" condim="1" priority="1" mass="0.2"/>
      <site name="imu"/>
      <body name="left" pos="0 {TRACK / 2} 0">
        <joint name="left" type="hinge" axis="0 1 0" armature="0.01"/>
        <geom type="ellipsoid" size="{WHEEL} 0.015 {WHEEL}" mass="0.3" friction="1.2"/></body>
      <body name="right" pos="0 {-TRACK / 2} 0">
        <joint name="right" type="hinge" axis="0 1 0" armature="0.01"/>
        <geom type="ellipsoid" size="{WHEEL} 0.015 {WHEEL}" mass="0.3" friction="1.2"/></body>
    </body>
"""
_DRIVES = """  <actuator><velocity joint="left" kv="5"/><velocity joint="right" kv="5"/></actuator>
  <sensor><gyro site="imu"/></sensor>
</mujoco>
"""


@dataclass(frozen=True)
class Errors:
    """Errors of the wheel odometry and the gyroscope."""

    wheels: float = 0.01
    """standard deviation of the scale of each wheel, sampled once per run"""
    slip: float = 0.002
    """standard deviation of the distance of a wheel after one metre, metres"""
    gyro_bias: float = 0.003
    """standard deviation of the bias, radians per second, sampled once per run"""
    gyro_noise: float = 0.002
    """standard deviation of each reading, radians per second"""
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Run:
    """Ground truth and measurements of a drive, every `CONTROL` seconds."""

    times: np.ndarray
    """(n,) seconds"""
    poses: np.ndarray
    """(n, 4, 4) world from the middle of the axle on the floor: x forward, z up"""
    wheels: np.ndarray
    """(n, 2) measured distance of the left and right wheel since the last reading, metres"""
    gyro: np.ndarray
    """(n,) measured rate about z, radians per second"""

    @property
    def length(self) -> float:
        """Length of the drive in metres."""
        return float(np.linalg.norm(np.diff(self.poses[:, :2, 3], axis=0), axis=1).sum())

    @property
    def camera(self) -> Trajectory:
        """Trajectory of the camera, world from camera, OpenCV axes."""
        return Trajectory(self.times, self.poses @ mount())


def mount() -> np.ndarray:
    """Pose of the camera on the robot (4, 4), robot from camera, OpenCV axes."""
    return rigid_matrix(CAMERA_AT, (0.5, -0.5, 0.5, -0.5))


def camera_at(camera: Camera, robot: np.ndarray) -> Camera:
    """The camera for a pose of the robot."""
    return camera.with_pose(np.linalg.inv(robot @ mount()))


def _mujoco() -> Any:
    """The package, without type information. Raises InputError if it is missing."""
    with required_package("MuJoCo", "sim"):
        import mujoco  # here, since only a drive needs it  # type: ignore[import-not-found]
    return mujoco


def drive(mjcf: str, path: np.ndarray, speed: float = 0.5, errors: Errors | None = None) -> Run:
    """Drive along a path in a model with `BODY`: straight segments, turns at the corners.

    Args:
        mjcf: text of the model, e.g. `Greenhouse.mjcf(BODY)`.
        path: (k, 2) corners in metres; the robot starts at the first and faces the second.
        speed: metres per second.

    Raises:
        InputError: MuJoCo is missing, fewer than two corners, or the robot is stuck.
    """
    mujoco = _mujoco()
    corners = np.asarray(path, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2:
        raise InputError(f"path must be two or more corners (k, 2), got {corners.shape}")
    model = mujoco.MjModel.from_xml_string(mjcf.replace("</mujoco>\n", _DRIVES))
    data = mujoco.MjData(model)
    first = corners[1] - corners[0]
    heading_change = math.atan2(first[1], first[0])
    data.qpos[:7] = [*corners[0], WHEEL, math.cos(heading_change / 2), 0, 0, math.sin(heading_change / 2)]
    steps = round(CONTROL / model.opt.timestep)
    address = [model.joint(name).qposadr[0] for name in ("left", "right")]
    times, poses, rolled, rotations = [], [], [], []

    def record() -> None:
        # the floor is one wheel radius below the body
        pose = np.eye(4)
        pose[:3, :3] = data.body("robot").xmat.reshape(3, 3)
        pose[:3, 3] = data.body("robot").xpos - WHEEL * pose[:3, 2]
        times.append(data.time)
        poses.append(pose)
        rolled.append(WHEEL * data.qpos[address])
        rotations.append(float(data.sensordata[2]))

    mujoco.mj_forward(model, data)
    record()
    forward = 0.0
    for start, goal in itertools.pairwise(corners):
        limit = len(times) + round((np.linalg.norm(goal - start) / speed + 20) / CONTROL)
        while (command := _command(poses[-1], start, goal, speed)) is not None:
            # full acceleration would tip the robot over
            forward = min(command[0], forward + MAX_ACCELERATION * CONTROL)
            around = command[1]
            data.ctrl[:] = (forward + np.array([-1, 1]) * around * TRACK / 2) / WHEEL
            mujoco.mj_step(model, data, steps)
            record()
            if len(times) > limit:
                at = tuple(np.round(poses[-1][:2, 3], 2).tolist())
                raise InputError(
                    f"the robot must be able to follow its path, got stuck at {at}; remove obstacles"
                )
    return _measured(
        np.array(times), np.array(poses), np.array(rolled), np.array(rotations), errors or Errors()
    )


def _command(
    pose: np.ndarray, start: np.ndarray, goal: np.ndarray, speed: float
) -> tuple[float, float] | None:
    """Speed and turn rate towards a corner; None once it is reached."""
    along = (goal - start) / np.linalg.norm(goal - start)
    here = pose[:2, 3]
    left = float((goal - here) @ along)
    if left < 0.01:
        return None
    aside = float(along[0] * (here - start)[1] - along[1] * (here - start)[0])
    heading = math.atan2(along[1], along[0]) - math.atan(2 * aside)
    off = heading - math.atan2(pose[1, 0], pose[0, 0])
    off = (off + math.pi) % (2 * math.pi) - math.pi
    around = max(-MAX_TURN_RATE, min(MAX_TURN_RATE, 3 * off))
    return (speed * min(1.0, left / 0.2 + 0.1) if abs(off) < 0.3 else 0.0), around


def _measured(
    times: np.ndarray, poses: np.ndarray, rolled: np.ndarray, turned: np.ndarray, errors: Errors
) -> Run:
    rng = np.random.default_rng(errors.seed)
    steps = np.diff(rolled, axis=0, prepend=rolled[:1])
    wheels = steps * (1 + rng.normal(0, errors.wheels, 2))
    wheels = wheels + errors.slip * np.sqrt(np.abs(steps)) * rng.normal(size=steps.shape)
    gyro = turned + rng.normal(0, errors.gyro_bias) + rng.normal(0, errors.gyro_noise, len(turned))
    return Run(times, poses, wheels, gyro)
