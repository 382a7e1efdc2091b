"""Reader of nerfstudio's transforms.json (docs.nerf.studio, "Data conventions") and NeRF's
transforms_train.json and transforms_test.json. Poses are camera to world with OpenGL's axes."""

from __future__ import annotations

from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.colmap import byte_colors
from fidsplat.formats.ply_header import read_header
from fidsplat.images.files import read_on_background
from fidsplat.train.dataset import TrainingView
from fidsplat.train.masks import Masks, undistorted_view
from fidsplat.util.errors import InputError, error_prefix
from fidsplat.util.files import from_json, path_of, read_text
from fidsplat.util.progress import Progress

_NAMES = ("transforms.json", "transforms_train.json")
_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""suffixes of image files; NeRF's transforms_train.json omits them"""
_BLACK = (0.0, 0.0, 0.0)


class DatasetContents(NamedTuple):
    """Views, points and background of a data set, before `Dataset` checks them."""

    views: list[TrainingView]
    held_out: list[TrainingView]
    points: np.ndarray
    colors: np.ndarray
    background: tuple[float, float, float]
    boxes: tuple[np.ndarray, ...] = ()


def has_transforms(path: Path) -> bool:
    """Whether `path` is a JSON file, or a folder with a transforms.json."""
    named = path.suffix.lower() == ".json" and path.is_file()
    return named or any((path / name).is_file() for name in _NAMES)


def load_transforms(path: Path, progress: Progress, masks: Masks) -> DatasetContents:
    """Read the views and points of transforms.json; images with alpha are composited over black.

    Views in its val_filenames and test_filenames, and in transforms_test.json next to it, are held out.

    Raises InputError for a damaged file, a missing image, or an unsupported lens.
    """
    file = path if path.is_file() else next(path / name for name in _NAMES if (path / name).is_file())
    table = _table(file)
    views, held_out = _divided(file, table, _views(file, table, progress, "images", masks))
    test = file.with_name("transforms_test.json")
    if test.is_file():
        held_out += _views(test, _table(test), progress, "test images", masks)
    points, colors = _points(file, table)
    return DatasetContents(views, held_out, points, colors, _BLACK)


def _table(file: Path) -> dict[str, Any]:
    try:
        table = from_json(read_text(file))
        frames = table.get("frames") if isinstance(table, dict) else None
        if not isinstance(frames, list):
            raise ValueError(f"frames must be a list, got {str(frames)[:80]!r}")
    except InputError:
        raise
    except ValueError as error:
        raise InputError(
            f"cannot read {file} as a transforms.json: {error}; export the data set again"
        ) from None
    return table


def _views(file: Path, table: dict, progress: Progress, label: str, masks: Masks) -> list[TrainingView]:
    views: list[TrainingView] = []
    others: set[tuple[int, int]] = set()
    for number, frame in enumerate(table["frames"]):
        progress(label, number / len(table["frames"]))
        try:
            name, _ = str(frame["file_path"]), frame["transform_matrix"]
        except (KeyError, TypeError):
            raise InputError(
                f"{file}: frame {number} must have a file_path and a transform_matrix of 4 x 4 finite "
                f"numbers, got {str(frame)[:80]!r}"
            ) from None
        source = _image_file(file, name, others)
        mask_file = file.parent / str(frame["mask_path"]) if "mask_path" in frame else None
        image, mask = read_on_background(source, _BLACK), masks.of(source, name, mask_file)
        views.append(undistorted_view(name, _camera(f"{file}: {name}", table, number, image), image, mask))
    return sorted(views, key=lambda view: view.name)


def _divided(
    file: Path, table: dict, views: list[TrainingView]
) -> tuple[list[TrainingView], list[TrainingView]]:
    """Training views and held-out views, by `train_filenames`, `val_filenames` and `test_filenames` of the
    file."""
    known, named = {PurePath(view.name) for view in views}, {}
    for split in ("train", "val", "test"):
        names = table.get(f"{split}_filenames") or []
        if not isinstance(names, list):
            raise InputError(
                f"{file}: {split}_filenames must be a list of the file_path of frames, got "
                f"{str(names)[:80]!r}"
            )
        named[split] = {PurePath(str(name)) for name in names}
        if unknown := named[split] - known:
            raise InputError(f"{file}: {split}_filenames must be file_paths of frames, got {min(unknown)}")
    trained = named["train"] or known - named["val"] - named["test"]
    held_out = (named["val"] | named["test"]) - trained
    first, second = ([view for view in views if PurePath(view.name) in part] for part in (trained, held_out))
    return first, second


def _image_file(file: Path, name: str, others: set[tuple[int, int]]) -> Path:
    candidates = [path_of(file.parent / (name + suffix)) for suffix in _SUFFIXES]
    image = next((candidate for candidate in candidates if candidate.is_file()), candidates[0])
    check_other_image(image, others)
    return image


def check_other_image(image: Path, others: set[tuple[int, int]]) -> None:
    """Raise InputError if two views have the same image file; otherwise a small file could fill the memory
    with copies of one image.

    others: device and inode of the images before; receives those of this one.
    """
    if not path_of(image).is_file():
        return  # the error is reported when the image is read
    status = image.stat()
    if (status.st_dev, status.st_ino) in others:
        raise InputError(f"views must have different images, got {image} twice; remove one of the views")
    others.add((status.st_dev, status.st_ino))


def _camera(what: str, table: dict, number: int, image: np.ndarray) -> Camera:
    height, width = image.shape[:2]
    with error_prefix(what):
        return Camera.from_nerfstudio({"w": width, "h": height} | table, number)


def _points(file: Path, table: dict) -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of the PLY file of the table, if it has one."""
    if not table.get("ply_file_path"):
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    header = read_header(file.parent / str(table["ply_file_path"]), text=True)
    element = header.elements.get("vertex")
    if element is None or not {"x", "y", "z"} <= set(element.properties):
        got = "none" if element is None else ", ".join(element.properties) or "no properties"
        raise InputError(f"{header.path} must have an element vertex with x, y and z for points, got {got}")
    rows = header.rows("vertex", 0, element.count)
    points = np.stack([rows[axis] for axis in "xyz"], axis=1).astype(np.float64)
    named = [name for name in ("red", "green", "blue") if name in element.properties]
    if len(named) < 3:
        return points, np.full((len(points), 3), 128, np.uint8)
    return points, byte_colors(str(header.path), np.stack([rows[name] for name in named], axis=1))
