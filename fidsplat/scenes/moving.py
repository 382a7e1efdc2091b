"""Shutters and keyframes in scene files."""

from collections.abc import Callable
from typing import Any

import numpy as np

from fidsplat.cameras import Shutter, Trajectory
from fidsplat.errors import InputError
from fidsplat.rotations import matrix_to_quaternion
from fidsplat.scenes.table import Table

SHUTTER = ("time", "exposure_time_ms", "sub_poses", "readout_ms", "rows_per_band")
POSE = ("time", "position", "quaternion")


def read_shutter(camera: Table) -> Shutter | None:
    """The shutter of a [camera] table; None if it has none."""
    if "shutter" not in camera:
        return None
    table, plain = camera.table("shutter", SHUTTER), Shutter()
    with table.at():
        return Shutter(
            time=table.number("time", plain.time),
            exposure_time=table.number("exposure_time_ms", 0.0) / 1e3,
            sub_poses=table.whole("sub_poses", plain.sub_poses),
            readout=table.number("readout_ms", 0.0) / 1e3,
            rows_per_band=table.whole("rows_per_band", plain.rows_per_band),
        )


def shutter_table(shutter: Shutter) -> dict:
    """What a shutter is written as."""
    return {
        "time": float(shutter.time),
        "exposure_time_ms": shutter.exposure_time * 1e3,
        "sub_poses": shutter.sub_poses,
        "readout_ms": shutter.readout * 1e3,
        "rows_per_band": shutter.rows_per_band,
    }


def read_keyframes(
    owner: Table, known: tuple[str, ...], pose_of: Callable[[Table], np.ndarray]
) -> Trajectory | None:
    """The trajectory of the list of tables `motion`; None if there is none. Raises InputError for times that
    do not increase."""
    frames = owner.tables("motion", known)
    if not frames:
        return None
    times = [frame.number("time") for frame in frames]
    for before, frame, time in zip(times, frames[1:], times[1:], strict=False):
        if time <= before:
            raise frame.error(
                "time", f"must be above that of the keyframe before, {before:g} s, not {time:g} s"
            )
    return Trajectory(times, np.array([pose_of(frame) for frame in frames]))


def keyframe_tables(motion: Any, who: str, camera: bool = False) -> list[dict]:
    """What a trajectory is written as, one table for each keyframe.

    Raises:
        InputError: it is a function, which a scene file cannot hold.
    """
    if not isinstance(motion, Trajectory):
        raise InputError(
            f"a scene file holds keyframes; the motion of {who} is a function. Sample it: "
            "fs.Trajectory(times, [pose(time) for time in times])"
        )
    tables = []
    for time, pose in zip(motion.times, motion.poses, strict=True):
        if camera:
            tables.append({"time": float(time), "world_to_camera": pose.tolist()})
        else:
            quaternion = matrix_to_quaternion(pose[:3, :3]).tolist()
            tables.append({"time": float(time), "position": pose[:3, 3].tolist(), "quaternion": quaternion})
    return tables
