"""Trajectories of cameras in files: TUM, KITTI, COLMAP and nerfstudio's transforms.json.

All of them as camera to world with OpenCV's axes, as ours are; transforms.json has OpenGL's (y up, z
backwards), COLMAP world to camera. Sources: the TUM RGB-D benchmark's "File Formats", KITTI's odometry
development kit, COLMAP's "Output format", nerfstudio's "Data conventions".
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Trajectory
from fidsplat.cameras.trajectory import check_rate
from fidsplat.formats.colmap import save_colmap
from fidsplat.formats.colmap_read import image_poses
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, path_of, read_input

MAX_BYTES = 2**28
"""of a file: TUM's two million poses"""
RATE = 10.0
"""poses a second of files that hold no times, as KITTI's were taken"""
ROUNDED = 1e-3
"""how far a file's rotation may be from one: six digits are common"""
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL's camera axes to OpenCV's, and back
_SUFFIXES = ".tum and .txt (TUM), .kitti, .json (transforms.json), or a folder (COLMAP)"


def load_trajectory(path: str | os.PathLike[str], rate: float = RATE, smooth: bool = False) -> Trajectory:
    """Read the camera-to-world poses of a file: TUM (8 numbers a line), KITTI (12), transforms.json, or
    COLMAP's images.txt, images.bin or the folder with them.

    Args:
        path: told apart by its ending and what it holds.
        rate: poses a second where the file has no times: KITTI's, COLMAP's (in the order of the images'
            names), and frames of transforms.json without "time".
        smooth: as `Trajectory.smooth`.

    Raises:
        InputError: naming file and line, for whatever is wrong: times that do not increase, values that are
            not finite, quaternions that are not of length 1 and matrices that are no rotations (within 1e-3).
    """
    file = path_of(path)
    check_rate(rate)
    if file.is_dir():
        file = _of_folder(file)
    content = read_input(file, MAX_BYTES)
    if file.suffix.lower() == ".bin" or file.name == "images.txt":
        times, poses = None, _colmap(file)
    else:
        try:
            text = content.decode("utf-8")
        except UnicodeDecodeError:
            raise InputError(f"{file} is not a trajectory: it is not text in UTF-8") from None
        if file.suffix.lower() == ".json":
            times, poses = _transforms(file, text)
        else:
            times, poses = _lines(file, text)
    if not len(poses):
        raise InputError(f"{file} holds no pose")
    try:
        return Trajectory(np.arange(len(poses)) / rate if times is None else times, np.array(poses), smooth)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def save_trajectory(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    camera: Camera | None = None,
    images: Sequence[str] | None = None,
) -> None:
    """Write camera-to-world poses: .tum or .txt (TUM), .kitti, .json (transforms.json), or a folder (COLMAP).

    KITTI and COLMAP hold no times. A trajectory that is smooth is written by its keyframes.

    Args:
        trajectory: k keyframes.
        path: its ending says the format.
        camera: its size and focal lengths, for transforms.json and COLMAP, which need them.
        images: k names of pictures for these two; frame-000000.png and so on when left out.

    Raises:
        InputError: an unknown ending, no camera where one is needed, a lens these formats are not written
            with, a number of names other than k, a file that cannot be written.
    """
    if not isinstance(trajectory, Trajectory):
        raise InputError(f"save_trajectory writes a Trajectory, not a {type(trajectory).__name__}")
    file = path_of(path)
    names = [f"frame-{k:06d}.png" for k in range(len(trajectory))] if images is None else images
    if isinstance(names, str) or not isinstance(names, Sequence) or len(names) != len(trajectory):
        raise InputError(f"images is {images!r}; give a name for each of {len(trajectory)} poses")
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"images is {images!r}; give names as text")
    suffix = file.suffix.lower()
    if suffix == "" or file.is_dir():
        lens = _pinhole(camera, file)
        poses = trajectory.inverse().poses
        cameras = [
            Camera.pinhole(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy, p) for p in poses
        ]
        save_colmap(file, names, cameras, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
        return
    if suffix in (".tum", ".txt"):
        rows = np.column_stack([trajectory.times, trajectory.vectors[:, [0, 1, 2, 4, 5, 6, 3]]])
        text = "# timestamp tx ty tz qx qy qz qw\n" + _rows(rows)
    elif suffix == ".kitti":
        text = _rows(trajectory.poses[:, :3, :].reshape(-1, 12))
    elif suffix == ".json":
        text = json.dumps(_said(trajectory, _pinhole(camera, file), names), indent=2) + "\n"
    else:
        raise InputError(f"cannot write a trajectory to {file}; known endings are {_SUFFIXES}")
    with atomic_write(file) as stream:
        stream.write(text.encode())


def _rows(rows: np.ndarray) -> str:
    # repr of a float is the shortest text that reads back as the same number
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


def _pinhole(camera: Camera | None, file: Path) -> Camera:
    if not isinstance(camera, Camera):
        raise InputError(f"{file} needs a camera as well, for its size and focal lengths; not {camera!r}")
    if camera.lens is not None:
        raise InputError(f"{file}: cameras with a lens ({camera.lens.kind}) are not written; give a pinhole")
    return camera


def _said(trajectory: Trajectory, camera: Camera, names: Sequence[str]) -> dict[str, Any]:
    frames = [
        {"file_path": name, "time": time, "transform_matrix": (pose @ _FLIP + 0.0).tolist()}
        for name, time, pose in zip(
            names, np.asarray(trajectory.times).tolist(), trajectory.poses, strict=True
        )
    ]
    intrinsics = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
    intrinsics |= {"cx": camera.cx, "cy": camera.cy}
    return {"camera_model": "OPENCV"} | intrinsics | {"frames": frames}


def _of_folder(folder: Path) -> Path:
    for name in ("images.bin", "images.txt", "transforms.json"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(f"{folder} is a folder without images.bin, images.txt or transforms.json")


def _lines(file: Path, text: str) -> tuple[list[float] | None, list[np.ndarray]]:
    """Times and poses of TUM's lines of 8 numbers, or the poses of KITTI's of 12."""
    times: list[float] = []
    poses: list[np.ndarray] = []
    width = None
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{file}, line {number}"
        values = _numbers(where, words)
        width = width or len(values)
        if width not in (8, 12) or len(values) != width:
            wanted = width if width in (8, 12) else "8 (TUM) or 12 (KITTI)"
            raise InputError(f"{where}: {len(values)} numbers; a trajectory has {wanted} on every line")
        if width == 12:
            poses.append(_rigid(where, np.vstack([np.reshape(values, (3, 4)), (0, 0, 0, 1)])))
            continue
        if times and not values[0] > times[-1]:
            raise InputError(
                f"{where}: the time {words[0]} is not above the one before, {times[-1]:.15g}; times must "
                "increase"
            )
        times.append(values[0])
        poses.append(_turned(where, values[1:4], (values[7], *values[4:7])))
    return times or None, poses


def _numbers(where: str, words: Sequence[Any]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: {' '.join(map(str, words))[:80]!r} are not numbers") from None
    if not all(map(math.isfinite, values)):
        raise InputError(f"{where}: a number is not finite")
    return values


def _turned(where: str, position: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    length = math.hypot(*quaternion)
    if abs(length - 1) > ROUNDED:
        raise InputError(f"{where}: the quaternion has the length {length:g}; it must be 1")
    return rigid_matrix(position, quaternion)


def _rigid(where: str, matrix: np.ndarray) -> np.ndarray:
    """The rigid matrix nearest to one that was rounded."""
    u, sizes, v = np.linalg.svd(matrix[:3, :3])
    if np.abs(sizes - 1).max() > ROUNDED or np.linalg.det(u @ v) < 0:
        scales = ", ".join(f"{size:.7g}" for size in sizes)
        raise InputError(f"{where}: the matrix must be a rotation, whose scales are 1, got {scales}")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 0:
        raise InputError(f"{where}: the matrix must have the last row (0, 0, 0, 1)")
    return rigid_matrix(matrix[:3, 3], matrix_to_quaternion(u @ v))


def _transforms(file: Path, text: str) -> tuple[list[float] | None, list[np.ndarray]]:
    try:
        frames = from_json(text)["frames"]
        pairs = [(frame.get("time"), np.array(frame["transform_matrix"], np.float64)) for frame in frames]
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise InputError(
            f'{file} is not a transforms.json: it needs "frames", a list of objects with a '
            f'"transform_matrix" of 4 x 4 numbers ({type(error).__name__}: {error})'
        ) from None
    poses = []
    for k, (_, matrix) in enumerate(pairs):
        where = f"{file}, frames[{k}].transform_matrix"
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, (0, 0, 0, 1)])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{where} must be 4 x 4 finite numbers")
        poses.append(_rigid(where, matrix) @ _FLIP)
    if any(time is None for time, _ in pairs):
        return None, poses
    return _numbers(f"{file}, the times of its frames", [time for time, _ in pairs]), poses


def _colmap(file: Path) -> list[np.ndarray]:
    """Camera to world of COLMAP's images, in the order of their names."""
    found = [
        _turned(f"{file}, image {name}", _numbers(f"{file}, image {name}", pose)[4:], pose[:4])
        for name, pose in image_poses(file)
    ]
    return list(Trajectory(np.arange(len(found)), np.array(found)).inverse().poses) if found else []
