"""Data sets from disk: COLMAP's, nerfstudio's transforms.json, and our own, which are COLMAP's with a
note."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fidsplat.formats.colmap_read import has_colmap, load_colmap
from fidsplat.images.files import read_image, read_over
from fidsplat.train.dataset import MOST_POINTS, Dataset, TrainingView
from fidsplat.train.flat import flat_view
from fidsplat.train.transforms import Found, has_transforms, load_transforms
from fidsplat.util.arguments import callback, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, path_of, read_text

NOTES = ("dataset.json", "marker.json")
"""files beside a data set of ours that may say its `background`: one display value, or three"""
_MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""where COLMAP's model may lie in a data set"""
HOLD_OUT, ENOUGH = 8, 16
"""every eighth view is held out where no other views are and there are this many"""

Progress = Callable[[str, float], None]
Background = tuple[float, float, float]


def load_dataset(
    path: str | Path,
    hold_out: int | None = None,
    random_points: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
) -> Dataset:
    """Read a data set.

    Args:
        path: a folder with COLMAP's model in `sparse/0` and pictures in `images`, or with `transforms.json`
            or `transforms_train.json`; or such a file.
        hold_out: every n-th view, in the order of their names, is kept to compare with; 0: none. By default
            the views in the folder `test` or of `transforms_test.json`, or else, of 16 views and more, every
            eighth.
        random_points: start from so many random points in place of those of the data set.
        seed: of the random points.
        progress: called with what is read and the share that is done.

    Raises:
        InputError: no data set, a picture that is missing or of another size than its camera, no points.
    """
    folder = path_of(path)
    if not folder.exists():
        raise InputError(f"{folder} is not there; give the folder of a data set")
    if hold_out is not None and whole_number("--hold-out", hold_out, 0, 2**31) == 1:
        raise InputError(f"--hold-out is {hold_out}; give 2 or more, every n-th view, or 0 for none")
    random_points = whole_number("--random-points", random_points, 0, MOST_POINTS)
    tell = callback("progress", progress) or (lambda words, share: None)
    found = (load_transforms if has_transforms(folder) else _load_colmap)(folder, tell)
    views, held_out = _divided(found.views, found.held_out, hold_out)
    points, colors = found.points, found.colors
    if not len(points) and not random_points:
        raise InputError(
            f"{folder} has no points to start from; give --random-points 5000, or a model with points"
        )
    made = Dataset(str(folder), views, held_out, points, colors, found.background)
    return made.with_random_points(random_points, seed) if random_points else made


def _divided(
    views: Sequence[TrainingView], held_out: Sequence[TrainingView], every: int | None
) -> tuple[tuple[TrainingView, ...], tuple[TrainingView, ...]]:
    if every is None:
        every = 0 if held_out or len(views) < ENOUGH else HOLD_OUT
    if every == 0:
        return tuple(views), tuple(held_out)
    return (
        tuple(view for i, view in enumerate(views) if i % every),
        (*views[::every], *held_out),
    )


def _load_colmap(folder: Path, tell: Progress) -> Found:
    place = next((folder / name for name in _MODELS if has_colmap(folder / name)), None)
    if place is None:
        raise InputError(
            f"{folder} holds no data set; known are COLMAP's (sparse/0/cameras.bin and images/) and "
            "nerfstudio's (transforms.json)"
        )
    background = _background(folder)
    views, points, colors = _model(folder, place, background, tell, "pictures")
    held_out: list[TrainingView] = []
    if has_colmap(folder / "test" / "sparse" / "0"):
        test = folder / "test"
        held_out, _, _ = _model(test, test / "sparse" / "0", background, tell, "test pictures")
    return Found(views, held_out, points, colors, background)


def _model(
    folder: Path, place: Path, background: Background, tell: Progress, words: str
) -> tuple[list[TrainingView], np.ndarray, np.ndarray]:
    model = load_colmap(place)
    views = []
    for i, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
        tell(words, i / len(model.names))
        picture = read_over(folder / "images" / name, background)
        views.append(flat_view(name, camera, picture, _mask(folder / "masks" / name)))
    return views, model.points, model.colors


def _mask(mask: Path) -> np.ndarray | None:
    # COLMAP adds .png to the picture's name, others put it in place of the suffix
    places = (mask.with_name(f"{mask.name}.png"), mask.with_suffix(".png"))
    there = next((place for place in places if place.is_file()), None)
    return None if there is None else read_image(there).max(axis=2) > 0


def _background(folder: Path) -> Background:
    for name in NOTES:
        file = folder / name
        if file.exists():
            text = read_text(file, "replace")
            try:
                value = from_json(text).get("background", 0.0)
                red, green, blue = np.broadcast_to(np.asarray(value, float), 3).tolist()
            except (ValueError, AttributeError, TypeError):
                raise InputError(f"{file} is damaged; background must be a number or three") from None
            return red, green, blue
    return (0.0, 0.0, 0.0)
