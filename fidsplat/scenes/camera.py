"""Lenses, shutters and keyframes in scene files: the subtables of [camera]."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from fidsplat.cameras import (
    BrownConrady,
    Camera,
    Equirectangular,
    Fisheye,
    Lens,
    Orthographic,
    RayTable,
    Shutter,
    Trajectory,
    fisheye_focal_length,
    focal_length,
)
from fidsplat.scenes.table import Table, names_of
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.util.errors import InputError

ORTHOGRAPHIC = ("metres_wide",)
TABLES = ("distortion", "fisheye", "equirectangular", "orthographic")
_NAME = {BrownConrady: "distortion", Fisheye: "fisheye"}
SHUTTER = ("time", "exposure_time_ms", "sub_poses", "readout_ms", "rows_per_band")
POSE = ("time", "position", "quaternion")


def read_lens(camera: Table) -> Lens | None:
    """The lens of a [camera] table; None for a pinhole. Raises InputError for two lenses."""
    named = [name for name in TABLES if name in camera]
    if len(named) > 1:
        raise camera.error(named[1], f"and {named[0]} exclude each other")
    if not named:
        return None
    if named[0] in ("distortion", "fisheye"):
        kind = BrownConrady if named[0] == "distortion" else Fisheye
        return kind(**camera.table(named[0], names_of(kind)).values(kind))
    if named[0] == "equirectangular":
        camera.table("equirectangular", ())
        return Equirectangular()
    camera.table("orthographic", ORTHOGRAPHIC)
    return Orthographic()


def read_focal_lengths(camera: Table, width: int, height: int, lens: Lens | None) -> tuple[float, float]:
    """fx and fy of a [camera] table, in pixels; per radian for a fisheye or panorama, per metre for an
    orthographic lens."""
    if isinstance(lens, Orthographic):
        table = camera.table("orthographic", ORTHOGRAPHIC)
        if "metres_wide" in table:
            wide = table.number("metres_wide")
            if not wide > 0:
                raise table.error("metres_wide", f"must be above 0, got {wide!r}")
            return width / wide, width / wide
    if isinstance(lens, Equirectangular) and "fx" not in camera and "fy" not in camera:
        if "fov_x_deg" in camera:
            raise camera.error(
                "fov_x_deg", "and equirectangular exclude each other: a panorama covers the sphere"
            )
        return width / (2 * math.pi), height / math.pi
    if "fov_x_deg" in camera:
        for key in ("fx", "fy"):
            if key in camera:
                raise camera.error(key, "and fov_x_deg exclude each other")
        if isinstance(lens, Orthographic):
            raise camera.error("fov_x_deg", "and orthographic exclude each other; give metres_wide there")
        angle = math.radians(camera.number("fov_x_deg"))
        width = min(max(width, 1), 32767)  # the camera reports an invalid width with its own key
        with camera.at("fov_x_deg"):
            fisheye = isinstance(lens, Fisheye)
            f = fisheye_focal_length(width, angle, lens) if fisheye else focal_length(width, angle)
        return f, f
    if "fx" in camera or "fy" in camera:
        return camera.number("fx"), camera.number("fy")
    if isinstance(lens, Orthographic):
        raise camera.error("orthographic.metres_wide", "is missing (or fx and fy in pixels per metre)")
    raise camera.error("fov_x_deg", "is missing (or fx and fy)")


def lens_table(camera: Camera) -> tuple[str, dict[str, float]] | None:
    """Name and values of the table of a camera's lens; None for a pinhole."""
    lens = camera.lens
    if lens is None:
        return None
    if isinstance(lens, BrownConrady | Fisheye):
        values = {name: getattr(lens, name) for name in names_of(type(lens))}
        return _NAME[type(lens)], {name: value for name, value in values.items() if value}
    if isinstance(lens, RayTable):
        raise InputError("the camera of a file must have a lens with coefficients, got a table of rays")
    return lens.kind, {}


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
                "time", f"must be above that of the keyframe before, {before:g} s, got {time:g} s"
            )
    return Trajectory(times, np.array([pose_of(frame) for frame in frames]))


def keyframe_tables(motion: Any, who: str, camera: bool = False) -> list[dict]:
    """Tables of the keyframes of a trajectory.

    Raises:
        InputError: the motion is a function or smooth, which a scene file cannot contain.
    """
    if not isinstance(motion, Trajectory):
        raise InputError(
            f"the motion of {who} must be an fs.Trajectory to be saved, got a function; sample it: "
            "fs.Trajectory(times, [pose(time) for time in times])"
        )
    if motion.smooth:
        raise InputError(
            f"the motion of {who} must have smooth=False to be saved, got smooth=True; sample it: "
            "motion.sampled(30)"
        )
    tables = []
    for time, pose in zip(motion.times, motion.poses, strict=True):
        if camera:
            tables.append({"time": float(time), "world_to_camera": pose.tolist()})
        else:
            quaternion = matrix_to_quaternion(pose[:3, :3]).tolist()
            tables.append({"time": float(time), "position": pose[:3, 3].tolist(), "quaternion": quaternion})
    return tables
