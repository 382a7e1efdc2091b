"""Reading and writing of COLMAP models as text and binary files: cameras, images and points3D.

Format: COLMAP's documentation, "Output format". Poses are world to camera with OpenCV's axes, as in fidsplat.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.rotations import matrix_to_quaternion, quaternion_to_matrix
from fidsplat.util.errors import InputError, error_prefix
from fidsplat.util.files import read_input, read_text, writable_folder, write_file

_PINHOLE = 1  # id of the camera model PINHOLE: fx, fy, cx, cy
_HEADS = {
    "cameras": "# Camera list with one line of data per camera:\n"
    "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n",
    "images": "# Image list with two lines of data per image:\n"
    "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n",
    "points3D": "# 3D point list with one line of data per point:\n"
    "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n",
}


def save_colmap(
    folder: str | Path,
    names: Sequence[str],
    cameras: Sequence[Camera],
    points: np.ndarray,
    colors: np.ndarray,
) -> list[Path]:
    """Write a COLMAP model: cameras, images and points3D, each as .txt and .bin.

    Args:
        folder: created if missing.
        names: n file names of the images, without white space.
        cameras: n cameras. Equal intrinsics become one COLMAP camera (model PINHOLE).
        points: (m, 3) float64 metres, written without tracks.
        colors: (m, 3) uint8.

    Raises InputError for a folder that cannot be written or an invalid name.
    """
    for name in names:
        if not name or name.split() != [name]:
            raise InputError(f"the name of a COLMAP image must have no white space, got {name!r}; rename it")
    if len(names) != len(cameras) or len(points) != len(colors):
        raise InputError(
            f"a COLMAP model must have a name for each camera and a colour for each point, got {len(names)} "
            f"names, {len(cameras)} cameras, {len(colors)} colours, {len(points)} points"
        )
    lenses: dict[tuple, int] = {}
    used = [lenses.setdefault((c.width, c.height, c.fx, c.fy, c.cx, c.cy), len(lenses) + 1) for c in cameras]
    poses = [(*matrix_to_quaternion(c.world_to_camera[:3, :3]), *c.world_to_camera[:3, 3]) for c in cameras]
    target = writable_folder(folder)
    texts = {
        "cameras": _lines((number, "PINHOLE", *lens) for lens, number in lenses.items()),
        "images": _lines(
            (i, *pose, lens, name, "\n")
            for i, (pose, lens, name) in enumerate(zip(poses, used, names, strict=True), 1)
        ),
        "points3D": _lines(
            (i, *place, *color, 0.0) for i, (place, color) in enumerate(zip(points, colors, strict=True), 1)
        ),
    }
    binaries = {
        "cameras": _count(lenses)
        + b"".join(struct.pack("<iiQQ4d", i, _PINHOLE, *lens) for lens, i in lenses.items()),
        "images": _count(names)
        + b"".join(
            struct.pack("<i7di", i, *pose, lens) + name.encode() + b"\0" + struct.pack("<Q", 0)
            for i, (pose, lens, name) in enumerate(zip(poses, used, names, strict=True), 1)
        ),
        "points3D": _count(points)
        + b"".join(
            struct.pack("<Q3d3BdQ", i, *place, *color, 0.0, 0)
            for i, (place, color) in enumerate(zip(points, colors, strict=True), 1)
        ),
    }
    files = []
    for name, head in _HEADS.items():
        for suffix, data in ((".txt", (head + texts[name]).encode()), (".bin", binaries[name])):
            files.append(target / f"{name}{suffix}")
            write_file(files[-1], data)
    return files


def _count(items) -> bytes:
    return struct.pack("<Q", len(items))


def _lines(rows) -> str:
    # repr writes the shortest text that reads back as the same float
    return "".join(
        " ".join(repr(float(v)) if isinstance(v, float) else str(v) for v in row).replace(" \n", "\n") + "\n"
        for row in rows
    )


_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}
"""name and number of parameters of COLMAP's camera models by id"""


@dataclass(frozen=True)
class ColmapModel:
    """Images, cameras and points of a COLMAP model."""

    names: tuple[str, ...]
    """image names, paths relative to the image folder, sorted"""
    cameras: tuple[Camera, ...]
    """camera of each image"""
    points: np.ndarray
    """(m, 3) float64 in the unit of the model"""
    colors: np.ndarray
    """(m, 3) uint8"""


def load_colmap(folder: Path) -> ColmapModel:
    """Read cameras, images and optionally points3D from a folder; binary files are preferred.

    Raises InputError for a missing or damaged file, or an unsupported camera model.
    """
    lenses = dict(_read(folder, "cameras", _binary_cameras, _text_cameras))
    views = sorted(_read(folder, "images", _binary_images, _text_images), key=lambda view: view[0])
    points = list(_read(folder, "points3D", _binary_points, _text_points, needed=False))
    if not views:
        raise InputError(f"the COLMAP model in {folder} must have images, got none")
    cameras = []
    for name, number, pose in views:
        if number not in lenses:
            raise InputError(f"{folder}: the camera of image {name} must be in cameras, got {number}")
        matrix = np.eye(4)
        # a quaternion of length 0 becomes NaN, which Camera rejects
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            matrix[:3, :3], matrix[:3, 3] = quaternion_to_matrix(np.array(pose[:4])), pose[4:]
        with error_prefix(f"{folder}: image {name}"):
            cameras.append(Camera.from_colmap(lenses[number], matrix))
    values = np.array(points, np.float64).reshape(-1, 6)
    return ColmapModel(
        tuple(name for name, _, _ in views),
        tuple(cameras),
        values[:, :3],
        byte_colors(f"{folder}: points3D", values[:, 3:]),
    )


def byte_colors(name: str, values: np.ndarray) -> np.ndarray:
    """Convert colours of points to uint8. Raises InputError for numbers outside 0 to 255."""
    if not ((values >= 0) & (values <= 255)).all():
        raise InputError(f"{name} must have colours from 0 to 255, got {values.min():g} to {values.max():g}")
    return values.astype(np.uint8)


def image_poses(file: Path) -> list[tuple[str, tuple[float, ...]]]:
    """Read images.bin or images.txt: sorted pairs of a name and a world-to-camera pose (quaternion w, x, y, z
    and translation). Raises InputError for a damaged file."""
    views = _read_file(file, _binary_images, _text_images)
    return sorted((name, pose) for name, _, pose in views)


def has_colmap(folder: Path) -> bool:
    """Whether a folder contains a COLMAP model."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def _read(folder: Path, name: str, binary, text, needed: bool = True) -> list:
    for suffix in (".bin", ".txt"):
        if (folder / f"{name}{suffix}").exists():
            return _read_file(folder / f"{name}{suffix}", binary, text)
    if not needed:
        return []
    raise InputError(f"a COLMAP model must have {name}.bin or {name}.txt, got neither in {folder}")


def _read_file(file: Path, binary, text) -> list:
    try:
        if file.suffix.lower() == ".bin":
            return list(binary(_BinaryReader(read_input(file))))
        lines = read_text(file).splitlines()
        return list(text([line.strip() for line in lines if not line.lstrip().startswith("#")]))
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise InputError(f"cannot read {file} as COLMAP: {error}; export the model again") from error


class _BinaryReader:
    """Sequential reader of a binary file."""

    def __init__(self, data: bytes) -> None:
        self._data, self._offset = data, 0

    def take(self, form: str) -> tuple:
        """Read the next numbers. form: a format of `struct`."""
        values = struct.unpack_from("<" + form, self._data, self._offset)
        self._offset += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        """Read a number of items; each item has at least one byte."""
        (count,) = self.take("Q")
        if count > len(self._data):
            raise ValueError(f"the file is too short for {count} items")
        return count

    def word(self) -> str:
        """Read a zero-terminated string."""
        end = self._data.index(b"\0", self._offset)
        text = self._data[self._offset : end].decode()
        self._offset = end + 1
        return text

    def skip(self, size: int) -> None:
        if self._offset + size > len(self._data):
            raise ValueError("the file is truncated")
        self._offset += size


_Intrinsics = tuple[str, int, int, tuple[float, ...]]
_View = tuple[str, int, tuple[float, ...]]


def _binary_cameras(data: _BinaryReader) -> Iterator[tuple[int, _Intrinsics]]:
    for _ in range(data.count()):
        number, model, width, height = data.take("iiQQ")
        if model not in _MODELS:
            raise ValueError(f"the model of camera {number} must be 0 to 11, got {model}")
        name, parameters = _MODELS[model]
        yield number, (name, width, height, data.take(f"{parameters}d"))


def _text_cameras(lines: list[str]) -> Iterator[tuple[int, _Intrinsics]]:
    for line in filter(None, lines):
        number, model, width, height, *parameters = line.split()
        expected = dict(_MODELS.values()).get(model, len(parameters))
        if len(parameters) != expected:
            raise ValueError(
                f"camera {number} of model {model} must have {expected} parameters, got {len(parameters)}"
            )
        yield int(number), (model, int(width), int(height), tuple(map(float, parameters)))


def _binary_images(data: _BinaryReader) -> Iterator[_View]:
    for _ in range(data.count()):
        _, *pose, camera = data.take("i7di")
        name = data.word()
        data.skip(24 * data.count())  # keypoints
        yield name, camera, tuple(pose)


def _text_images(lines: list[str]) -> Iterator[_View]:
    # every second line contains the keypoints and may be empty
    for line in lines[::2]:
        if line:
            words = line.split(maxsplit=9)
            if len(words) < 10:
                raise ValueError(f"the line of an image must have 10 words, got {line!r}")
            yield words[9], int(words[8]), tuple(map(float, words[1:8]))


def _binary_points(data: _BinaryReader) -> Iterator[tuple]:
    for _ in range(data.count()):
        _, *values, _ = data.take("Q3d3Bd")
        data.skip(8 * data.count())  # track
        yield tuple(values)


def _text_points(lines: list[str]) -> Iterator[tuple]:
    for line in filter(None, lines):
        _, x, y, z, r, g, b, *_ = line.split()
        yield tuple(map(float, (x, y, z, r, g, b)))
