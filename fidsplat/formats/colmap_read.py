"""Reading models in COLMAP's format, text or binary (COLMAP's documentation, "Output format")."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye, Lens
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.errors import InputError
from fidsplat.util.files import read_input, read_text

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
"""camera models by their numbers: name, parameters"""
_LENSES: dict[str, tuple[type[BrownConrady | Fisheye], tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (BrownConrady, ()),
    "PINHOLE": (BrownConrady, ()),
    "SIMPLE_RADIAL": (BrownConrady, ("k1",)),
    "RADIAL": (BrownConrady, ("k1", "k2")),
    "OPENCV": (BrownConrady, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (BrownConrady, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "OPENCV_FISHEYE": (Fisheye, ("k1", "k2", "k3", "k4")),
    "SIMPLE_RADIAL_FISHEYE": (Fisheye, ("k1",)),
    "RADIAL_FISHEYE": (Fisheye, ("k1", "k2")),
}
"""those that we have, with the last of their parameters; before them stand f or fx and fy, cx and cy"""


@dataclass(frozen=True)
class ColmapModel:
    """What a model says of a scene."""

    names: tuple[str, ...]
    """of the images, as paths below the folder of images, in their alphabetical order"""
    cameras: tuple[Camera, ...]
    """of each image"""
    points: np.ndarray
    """(m, 3) float64, metres (or whatever unit the model has)"""
    colors: np.ndarray
    """(m, 3) uint8"""


def load_colmap(folder: Path) -> ColmapModel:
    """Read cameras, images and points3D from a folder, binary where both are there; without points3D there
    are no points.

    Raises InputError when a file is missing or damaged, or a camera has a lens that we lack.
    """
    lenses = dict(_read(folder, "cameras", _binary_cameras, _text_cameras))
    views = sorted(_read(folder, "images", _binary_images, _text_images), key=lambda view: view[0])
    found = list(_read(folder, "points3D", _binary_points, _text_points, needed=False))
    if not views:
        raise InputError(f"the COLMAP model in {folder} has no images; give one with views")
    cameras = []
    for name, number, pose in views:
        if number not in lenses:
            raise InputError(f"{folder}: image {name} has camera {number}, which cameras does not have")
        matrix = np.eye(4)
        with np.errstate(invalid="ignore"):  # of 0 none is made, and the camera says so
            matrix[:3, :3], matrix[:3, 3] = quaternion_to_matrix(np.array(pose[:4])), pose[4:]
        try:
            cameras.append(_camera(lenses[number], matrix))
        except InputError as error:
            raise InputError(f"{folder}: image {name}: {error}") from error
    values = np.array(found, np.float64).reshape(-1, 6)
    return ColmapModel(
        tuple(name for name, _, _ in views),
        tuple(cameras),
        values[:, :3],
        byte_colors(f"{folder}: points3D", values[:, 3:]),
    )


def byte_colors(name: str, values: np.ndarray) -> np.ndarray:
    """Colors of points as uint8. Raises InputError for numbers that are not from 0 to 255."""
    if not ((values >= 0) & (values <= 255)).all():
        raise InputError(f"{name} must have colors from 0 to 255; check the file")
    return values.astype(np.uint8)


def image_poses(file: Path) -> list[tuple[str, tuple[float, ...]]]:
    """Names of the images in a file images.bin or images.txt, in their alphabetical order, with the poses
    world to camera: quaternion w, x, y, z and translation, as they stand there. Raises InputError for a
    damaged file."""
    views = _read_file(file, _binary_images, _text_images)
    return sorted((name, pose) for name, _, pose in views)


def has_colmap(folder: Path) -> bool:
    """Whether a model lies in the folder."""
    return any((folder / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt"))


def _read(folder: Path, name: str, binary, text, needed: bool = True) -> list:
    for suffix in (".bin", ".txt"):
        if (folder / f"{name}{suffix}").exists():
            return _read_file(folder / f"{name}{suffix}", binary, text)
    if not needed:
        return []
    raise InputError(f"{folder} has neither {name}.bin nor {name}.txt; it is no COLMAP model")


def _read_file(file: Path, binary, text) -> list:
    try:
        if file.suffix.lower() == ".bin":
            return list(binary(_Bytes(read_input(file))))
        lines = read_text(file).splitlines()
        return list(text([line.strip() for line in lines if not line.lstrip().startswith("#")]))
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise InputError(f"{file} is damaged, or not COLMAP's: {error}; export the model again") from error


class _Bytes:
    """A binary file, read from its beginning on."""

    def __init__(self, data: bytes) -> None:
        self._data, self._place = data, 0

    def take(self, form: str) -> tuple:
        """The next numbers."""
        values = struct.unpack_from("<" + form, self._data, self._place)
        self._place += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        """The next number of things, of which each takes a byte at least."""
        (count,) = self.take("Q")
        if count > len(self._data):
            raise ValueError(f"it says that it holds {count} things")
        return count

    def word(self) -> str:
        """The next text, which a zero ends."""
        end = self._data.index(b"\0", self._place)
        text = self._data[self._place : end].decode()
        self._place = end + 1
        return text

    def skip(self, size: int) -> None:
        """Leaves out so many bytes."""
        if self._place + size > len(self._data):
            raise ValueError("it ends too early")
        self._place += size


_Taken = tuple[str, int, int, tuple[float, ...]]
_View = tuple[str, int, tuple[float, ...]]


def _binary_cameras(data: _Bytes) -> Iterator[tuple[int, _Taken]]:
    for _ in range(data.count()):
        number, model, width, height = data.take("iiQQ")
        if model not in _MODELS:
            raise ValueError(f"camera {number} has a model that is not known, {model}")
        name, parameters = _MODELS[model]
        yield number, (name, width, height, data.take(f"{parameters}d"))


def _text_cameras(lines: list[str]) -> Iterator[tuple[int, _Taken]]:
    for line in filter(None, lines):
        number, model, width, height, *parameters = line.split()
        if len(parameters) != dict(_MODELS.values()).get(model, len(parameters)):
            raise ValueError(f"camera {number} is {model} with {len(parameters)} parameters")
        yield int(number), (model, int(width), int(height), tuple(map(float, parameters)))


def _binary_images(data: _Bytes) -> Iterator[_View]:
    for _ in range(data.count()):
        _, *pose, camera = data.take("i7di")
        name = data.word()
        data.skip(24 * data.count())  # points that were found in the picture
        yield name, camera, tuple(pose)


def _text_images(lines: list[str]) -> Iterator[_View]:
    # every second line has the points that were found in the picture, and may be empty
    for line in lines[::2]:
        if line:
            words = line.split(maxsplit=9)
            if len(words) < 10:
                raise ValueError(f"the line {line!r} has {len(words)} of the 10 words of an image")
            yield words[9], int(words[8]), tuple(map(float, words[1:8]))


def _binary_points(data: _Bytes) -> Iterator[tuple]:
    for _ in range(data.count()):
        _, *values, _ = data.take("Q3d3Bd")
        data.skip(8 * data.count())  # pictures that it was seen in
        yield tuple(values)


def _text_points(lines: list[str]) -> Iterator[tuple]:
    for line in filter(None, lines):
        _, x, y, z, r, g, b, *_ = line.split()
        yield tuple(map(float, (x, y, z, r, g, b)))


def _camera(taken: _Taken, pose: np.ndarray) -> Camera:
    model, width, height, values = taken
    if model not in _LENSES:
        raise InputError(
            f"its camera has the model {model}, and known are {', '.join(_LENSES)}; undistort the pictures "
            "first, e.g. by colmap image_undistorter"
        )
    kind, names = _LENSES[model]
    own = len(values) - len(names)
    lens: Lens = kind(**dict(zip(names, values[own:], strict=True)))
    fx, fy, cx, cy = values[:own] if own == 4 else (values[0], *values[:3])
    return Camera.pinhole(width, height, fx, fy, cx, cy, pose, lens=lens)
