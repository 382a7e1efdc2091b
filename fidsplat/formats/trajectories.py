"""Reading and writing of trajectories as TUM, KITTI, COLMAP and nerfstudio's transforms.json, and reading of
cameras of the last two.

Poses are converted to camera to world with OpenCV's axes; transforms.json has OpenGL's axes (y up, z
backwards), COLMAP stores world to camera. Sources: the TUM RGB-D benchmark's "File Formats", KITTI's odometry
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

from fidsplat.cameras import BrownConrady, Camera, Fisheye, Lens, Trajectory
from fidsplat.cameras.foreign import COEFFICIENTS, OPENGL_AXES
from fidsplat.cameras.trajectory import check_rate
from fidsplat.formats.colmap import has_colmap, image_poses, load_colmap, save_colmap
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.util.arguments import instance
from fidsplat.util.errors import InputError, error_prefix
from fidsplat.util.files import from_json, path_of, read_input, read_text, write_file

MAX_BYTES = 2**28
"""maximum size of a file in bytes: about two million poses in TUM's format"""
RATE = 10.0
"""poses per second for files without times, the rate of KITTI"""
ROUNDED = 1e-3
"""tolerance of rotations, since files often have six digits"""
_SUFFIXES = ".tum and .txt (TUM), .kitti, .json (transforms.json), or a folder (COLMAP)"


def load_trajectory(path: str | os.PathLike[str], rate: float = RATE, smooth: bool = False) -> Trajectory:
    """Read a trajectory file: TUM (8 numbers per line), KITTI (12 numbers per line), transforms.json, or
    COLMAP's images.txt, images.bin or their folder. Poses are camera to world.

    Args:
        path: suffix and content determine the format.
        rate: poses per second for files without times: KITTI, COLMAP (sorted by image name), and
            transforms.json without "time".
        smooth: interpolate poses smoothly (`Trajectory.smooth`).

    Raises:
        InputError: the file is invalid; the message names the line. Times must increase, values be finite,
            quaternions have length 1, and matrices be rotations (within 1e-3).
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
            raise InputError(f"a trajectory must be text in UTF-8, got {file}") from None
        if file.suffix.lower() == ".json":
            times, poses = _transforms(file, text)
        else:
            times, poses = _lines(file, text)
    if not len(poses):
        raise InputError(f"a trajectory must have at least one pose, got none in {file}")
    with error_prefix(str(file)):
        return Trajectory(np.arange(len(poses)) / rate if times is None else times, np.array(poses), smooth)


def save_trajectory(
    trajectory: Trajectory,
    path: str | os.PathLike[str],
    camera: Camera | None = None,
    images: Sequence[str] | None = None,
) -> None:
    """Write camera-to-world poses: .tum or .txt (TUM), .kitti, .json (transforms.json), or a folder (COLMAP).

    KITTI and COLMAP store no times. For a smooth trajectory the keyframes are written.

    Args:
        trajectory: k keyframes.
        path: its suffix selects the format.
        camera: size and intrinsics, required for transforms.json and COLMAP.
        images: k image names for these two formats; default: frame-000000.png and so on.

    Raises:
        InputError: the suffix is unknown, the camera is missing or has a lens that the format lacks, the
            number of names is not k, or the file cannot be written.
    """
    instance("trajectory", trajectory, Trajectory)
    file = path_of(path)
    names = [f"frame-{k:06d}.png" for k in range(len(trajectory))] if images is None else images
    if isinstance(names, str) or not isinstance(names, Sequence) or len(names) != len(trajectory):
        raise InputError(f"images must have a name for each of {len(trajectory)} poses, got {images!r}")
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"images must be names as text, got {images!r}")
    check_trajectory_file(file, camera)
    suffix = file.suffix.lower()
    if suffix == "" or file.is_dir():
        lens = _camera(camera, file)
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
    else:
        text = json.dumps(_transforms_json(trajectory, _camera(camera, file), names), indent=2) + "\n"
    write_file(file, text)


def check_trajectory_file(path: str | os.PathLike[str], camera: Camera | None) -> None:
    """Raise InputError for an unknown suffix, or a camera that the format does not support."""
    file = path_of(path)
    suffix = file.suffix.lower()
    if suffix == "" or file.is_dir():
        if (lens := _camera(camera, file).lens) is not None:
            raise InputError(f"the camera of {file} must be a pinhole, got the lens {lens.kind}")
    elif suffix == ".json":
        _camera(camera, file)
    elif suffix not in (".tum", ".txt", ".kitti"):
        raise InputError(f"the suffix of a trajectory must be one of {_SUFFIXES}, got {file}")


def _rows(rows: np.ndarray) -> str:
    # repr writes the shortest text that reads back as the same float
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


def _camera(camera: Camera | None, file: Path) -> Camera:
    if not isinstance(camera, Camera):
        raise InputError(f"camera must be a Camera for {file}, got {camera!r}; give camera=")
    return camera


def lens_table(lens: Lens | None) -> dict[str, Any] | None:
    """A lens as values of nerfstudio's transforms.json; None for a lens that the format lacks."""
    if lens is None:
        return {"camera_model": "OPENCV"}
    values = {name: value for name, value in vars(lens).items() if name in COEFFICIENTS and value}
    if isinstance(lens, Fisheye):
        return {"camera_model": "OPENCV_FISHEYE"} | values
    if not isinstance(lens, BrownConrady) or any((lens.s1, lens.s2, lens.s3, lens.s4)):
        return None
    rational = any((lens.k4, lens.k5, lens.k6))
    return {"camera_model": "FULL_OPENCV" if rational else "OPENCV"} | values


def _transforms_json(trajectory: Trajectory, camera: Camera, names: Sequence[str]) -> dict[str, Any]:
    frames = [
        {"file_path": name, "time": time, "transform_matrix": (pose @ OPENGL_AXES + 0.0).tolist()}
        for name, time, pose in zip(
            names, np.asarray(trajectory.times).tolist(), trajectory.poses, strict=True
        )
    ]
    intrinsics = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
    intrinsics |= {"cx": camera.cx, "cy": camera.cy}
    lens = lens_table(camera.lens)
    if lens is None:
        raise InputError(
            "the lens of a transforms.json must be a fisheye, or brown_conrady without s1 to s4, got "
            f"{camera.lens}; write .tum"
        )
    return lens | intrinsics | {"frames": frames}


def _of_folder(folder: Path) -> Path:
    for name in ("images.bin", "images.txt", "transforms.json"):
        if (folder / name).is_file():
            return folder / name
    raise InputError(
        f"a trajectory folder must have images.bin, images.txt or transforms.json, got none in {folder}"
    )


def _lines(file: Path, text: str) -> tuple[list[float] | None, list[np.ndarray]]:
    """Parse lines of 8 numbers (TUM, with times) or 12 numbers (KITTI)."""
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
            expected = width if width in (8, 12) else "8 (TUM) or 12 (KITTI)"
            raise InputError(f"{where}: a line must have {expected} numbers, got {len(values)}")
        if width == 12:
            poses.append(_rigid(where, np.vstack([np.reshape(values, (3, 4)), (0, 0, 0, 1)])))
            continue
        if times and not values[0] > times[-1]:
            raise InputError(f"{where}: times must increase, got {words[0]} after {times[-1]:.15g}")
        times.append(values[0])
        poses.append(_pose(where, values[1:4], (values[7], *values[4:7])))
    return times or None, poses


def _numbers(where: str, words: Sequence[Any]) -> list[float]:
    try:
        values = [float(word) for word in words]
    except (TypeError, ValueError, OverflowError):
        raise InputError(
            f"{where}: a line must have numbers, got {' '.join(map(str, words))[:80]!r}"
        ) from None
    if not all(map(math.isfinite, values)):
        wrong = next(value for value in values if not math.isfinite(value))
        raise InputError(f"{where}: numbers must be finite, got {wrong}")
    return values


def _pose(where: str, position: Sequence[float], quaternion: Sequence[float]) -> np.ndarray:
    length = math.hypot(*quaternion)
    if abs(length - 1) > ROUNDED:
        raise InputError(f"{where}: the length of the quaternion must be 1, got {length:g}")
    return rigid_matrix(position, quaternion)


def _rigid(where: str, matrix: np.ndarray) -> np.ndarray:
    """The rigid matrix nearest to a rounded matrix."""
    u, sizes, v = np.linalg.svd(matrix[:3, :3])
    if np.abs(sizes - 1).max() > ROUNDED or np.linalg.det(u @ v) < 0:
        scales = ", ".join(f"{size:.7g}" for size in sizes)
        raise InputError(f"{where}: the matrix must be a rotation, whose scales are 1, got {scales}")
    if np.abs(matrix[3] - (0, 0, 0, 1)).max() > 0:
        raise InputError(
            f"{where}: the matrix must have the last row (0, 0, 0, 1), got {tuple(matrix[3].tolist())}"
        )
    return rigid_matrix(matrix[:3, 3], matrix_to_quaternion(u @ v))


def _transforms(file: Path, text: str) -> tuple[list[float] | None, list[np.ndarray]]:
    try:
        frames = from_json(text)["frames"]
        pairs = [(frame.get("time"), np.array(frame["transform_matrix"], np.float64)) for frame in frames]
    except (ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        raise InputError(
            f'{file} must have "frames", a list of objects with a '
            f'"transform_matrix" of 4 x 4 numbers, got {type(error).__name__}: {error}'
        ) from None
    poses = []
    for k, (_, matrix) in enumerate(pairs):
        where = f"{file}, frames[{k}].transform_matrix"
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, (0, 0, 0, 1)])
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{where} must be 4 x 4 finite numbers, got {matrix.tolist()}")
        poses.append(_rigid(where, matrix) @ OPENGL_AXES)
    if any(time is None for time, _ in pairs):
        return None, poses
    return _numbers(f"{file}, the times of its frames", [time for time, _ in pairs]), poses


def _colmap(file: Path) -> list[np.ndarray]:
    """Camera-to-world matrices of COLMAP's images, sorted by name."""
    poses = [
        _pose(f"{file}, image {name}", _numbers(f"{file}, image {name}", pose)[4:], pose[:4])
        for name, pose in image_poses(file)
    ]
    return list(Trajectory(np.arange(len(poses)), np.array(poses)).inverse().poses) if poses else []


_MODELS = (".", "sparse/0", "sparse", "colmap/sparse/0")
_TRANSFORMS = ("transforms.json", "transforms_train.json")


def load_cameras(path: str | os.PathLike[str]) -> dict[str, Camera]:
    """Cameras by image name, from a COLMAP model (its folder, or a folder that contains `sparse/0`) or
    nerfstudio's transforms.json (the file or its folder).

    Raises:
        InputError: the path is neither, a file is damaged, or a lens is not supported.
    """
    file = path_of(path)
    for place in (file / name for name in _MODELS):
        if has_colmap(place):
            model = load_colmap(place)
            return dict(zip(model.names, model.cameras, strict=True))
    files = [candidate for candidate in (file, *(file / name for name in _TRANSFORMS)) if candidate.is_file()]
    if not files:
        raise InputError(
            "path must be a transforms.json, or a folder with one or with a COLMAP model (cameras.bin), "
            f"got {file}"
        )
    try:
        transforms = from_json(read_text(files[0]))
        names = [str(frame["file_path"]) for frame in transforms["frames"]]
    except (ValueError, TypeError, KeyError) as error:
        raise InputError(
            f"cannot read {files[0]} as a transforms.json: {error}; export the data set again"
        ) from None
    cameras = {}
    for number, name in enumerate(names):
        with error_prefix(f"{files[0]}: {name}"):
            cameras[name] = Camera.from_nerfstudio(transforms, number)
    return cameras
