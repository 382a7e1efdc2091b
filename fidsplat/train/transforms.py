"""nerfstudio's data sets: transforms.json (docs.nerf.studio, "Data conventions"), and the NeRF authors'
transforms_train.json with transforms_test.json. Poses are camera to world with OpenGL's axes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye, Lens, focal_length
from fidsplat.formats.ply_header import read_header
from fidsplat.images.files import read_image, read_over
from fidsplat.train.dataset import TrainingView
from fidsplat.train.flat import flat_view
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text

_NAMES = ("transforms.json", "transforms_train.json")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""the NeRF authors' files name pictures without one"""
_BROWN = ("k1", "k2", "k3", "p1", "p2")
_LENSES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), _BROWN),
    "FULL_OPENCV": (*_BROWN, "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""values of `camera_model`, with the coefficients that are taken with each"""
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_BLACK = (0.0, 0.0, 0.0)


class Found(NamedTuple):
    """What a data set's files hold, before it is checked as a whole."""

    views: list[TrainingView]
    held_out: list[TrainingView]
    points: np.ndarray
    colors: np.ndarray
    background: tuple[float, float, float]


def has_transforms(path: Path) -> bool:
    """Whether this is such a file, or a folder with one."""
    named = path.suffix.lower() == ".json" and path.is_file()
    return named or any((path / name).is_file() for name in _NAMES)


def load_transforms(path: Path, tell: Callable[[str, float], None]) -> Found:
    """Read the views, the points that the file names, and as views held out those of its val_filenames and
    test_filenames and of transforms_test.json beside it.

    Pictures with alpha are put on black.

    Raises InputError for a file that is damaged, a picture that is missing, or a lens that we lack.
    """
    file = path if path.is_file() else next(path / name for name in _NAMES if (path / name).is_file())
    table = _table(file)
    views, held_out = _divided(file, table, _views(file, table, tell, "pictures"))
    test = file.with_name("transforms_test.json")
    if test.is_file():
        held_out += _views(test, _table(test), tell, "test pictures")
    points, colors = _points(file, table)
    return Found(views, held_out, points, colors, _BLACK)


def _table(file: Path) -> dict[str, Any]:
    try:
        table = from_json(read_text(file))
        if not isinstance(table, dict) or not isinstance(table.get("frames"), list):
            raise ValueError("it has no list of frames")
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{file} is no transforms.json: {error}") from None
    return table


def _views(file: Path, table: dict, tell: Callable[[str, float], None], words: str) -> list[TrainingView]:
    views = []
    for number, frame in enumerate(table["frames"]):
        tell(words, number / len(table["frames"]))
        try:
            name, matrix = str(frame["file_path"]), np.array(frame["transform_matrix"], float)
            if matrix.shape == (3, 4):
                matrix = np.vstack([matrix, (0, 0, 0, 1)])
            if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
                raise ValueError
        except (KeyError, TypeError, ValueError, OverflowError):
            raise InputError(
                f"{file}: frame {number} needs a file_path and a transform_matrix of 4 x 4 finite numbers"
            ) from None
        picture, mask = _picture(file, name), None
        if "mask_path" in frame:
            mask = read_image(file.parent / str(frame["mask_path"])).max(axis=2) > 0
        given = {**table, **frame}
        views.append(flat_view(name, _camera(f"{file}: {name}", given, picture, matrix), picture, mask))
    return sorted(views, key=lambda view: view.name)


def _divided(
    file: Path, table: dict, views: list[TrainingView]
) -> tuple[list[TrainingView], list[TrainingView]]:
    """Those to train on and those held out, where the file names them."""
    known, named = {PurePath(view.name) for view in views}, {}
    for split in ("train", "val", "test"):
        names = table.get(f"{split}_filenames") or []
        if not isinstance(names, list):
            raise InputError(f"{file}: {split}_filenames must be a list of the file_path of frames")
        named[split] = {PurePath(str(name)) for name in names}
        if unknown := named[split] - known:
            raise InputError(f"{file}: {split}_filenames has {min(unknown)}, which is no frame's file_path")
    trained = named["train"] or known - named["val"] - named["test"]
    held_out = (named["val"] | named["test"]) - trained
    one, other = ([view for view in views if PurePath(view.name) in part] for part in (trained, held_out))
    return one, other


def _picture(file: Path, name: str) -> np.ndarray:
    places = [file.parent / (name + suffix) for suffix in _SUFFIXES]
    place = next((place for place in places if place.is_file()), places[0])
    return read_over(place, _BLACK)


def _camera(what: str, given: dict, picture: np.ndarray, camera_to_world: np.ndarray) -> Camera:
    height, width = picture.shape[:2]
    try:
        stated = int(given.get("w", width)), int(given.get("h", height))
        if "fl_x" in given:
            fx = float(given["fl_x"])
        else:
            fx = focal_length(stated[0], float(given["camera_angle_x"]))
        fy = float(given.get("fl_y", fx))
        cx, cy = float(given.get("cx", stated[0] / 2)), float(given.get("cy", stated[1] / 2))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{what}: needs fl_x, or camera_angle_x, as a finite number") from None
    pose = camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])
    turn = pose[:3, :3].T
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3], world_to_camera[:3, 3] = turn, -turn @ pose[:3, 3]
    try:
        return Camera.pinhole(*stated, fx, fy, cx, cy, world_to_camera, lens=_lens(given))
    except InputError as error:
        raise InputError(f"{what}: {error}") from error


def _lens(given: dict) -> Lens:
    model = given.get("camera_model", "OPENCV_FISHEYE" if given.get("is_fisheye") else "PINHOLE")
    if model not in _LENSES:
        raise InputError(
            f"its camera_model is {model!r}, and known are {', '.join(_LENSES)}; undistort the pictures first"
        )
    values = {name: given[name] for name in _COEFFICIENTS if given.get(name)}
    if others := values.keys() - _LENSES[model]:
        name = min(others)
        raise InputError(
            f"{name} is {values[name]!r}, which the camera_model {model} does not have (it has "
            f"{', '.join(_LENSES[model])}); undistort the pictures first"
        )
    return (Fisheye if model == "OPENCV_FISHEYE" else BrownConrady)(**values)


def _points(file: Path, table: dict) -> tuple[np.ndarray, np.ndarray]:
    """Points of the PLY file that the table names; none where it names none."""
    if not table.get("ply_file_path"):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    header = read_header(file.parent / str(table["ply_file_path"]), text=True)
    element = header.elements.get("vertex")
    if element is None or not {"x", "y", "z"} <= set(element.properties):
        raise InputError(f"{header.path} has no points: its element vertex needs x, y and z")
    rows = header.rows("vertex", 0, element.count)
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    named = [name for name in ("red", "green", "blue") if name in element.properties]
    if len(named) < 3:
        return points, np.full((len(points), 3), 128, np.uint8)
    return points, np.stack([rows[name] for name in named], axis=1).astype(np.uint8)
