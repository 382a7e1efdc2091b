"""Reader of data sets: COLMAP's layout, with fidsplat's marker.json if present, and nerfstudio's
transforms.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fidsplat.formats.colmap import has_colmap, load_colmap
from fidsplat.images.files import read_on_background
from fidsplat.train.boxes import MarkerBox, read_boxes, without_markers
from fidsplat.train.dataset import MAX_POINTS, Dataset, TrainingView
from fidsplat.train.masks import Masks, mask_file, undistorted_view
from fidsplat.train.transforms import DatasetContents, check_other_image, has_transforms, load_transforms
from fidsplat.util.arguments import callback, flag, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, path_of, read_text
from fidsplat.util.progress import Progress, no_progress

METADATA = ("dataset.json", "marker.json")
"""files of fidsplat's data sets with the fields `background`, one display value or three, and `boxes`"""
_MODELS = ("sparse/0", "sparse", "colmap/sparse/0", ".")
"""folders of COLMAP's model in a data set"""
HOLD_OUT, MIN_VIEWS_TO_HOLD_OUT = 8, 16
"""in data sets of at least 16 views without a test set, every eighth view is held out"""

Background = tuple[float, float, float]


def load_dataset(
    path: str | Path,
    hold_out: int | None = None,
    random_points: int = 0,
    seed: int = 0,
    progress: Progress | None = None,
    masks: str | Path | None = None,
    alpha_masks: bool = False,
) -> Dataset:
    """Read a data set.

    Args:
        path: a folder with COLMAP's model in `sparse/0` and images in `images`, or with `transforms.json` or
            `transforms_train.json`; or one of these files.
        hold_out: n holds out every n-th view in the order of names, 0 none. None holds out the views in the
            folder `test` or in `transforms_test.json`; without them, every eighth of 16 or more views.
        random_points: number of random initial points that replace those of the data set; 0 keeps these.
        seed: seed of the random points.
        progress: called with a description of the file and the fraction done, 0 to 1.
        masks: folder of masks `NAME.png`, 0 for ignored pixels, in addition to the masks of the data set.
        alpha_masks: whether the loss ignores transparent pixels; otherwise they show the background.

    Raises:
        InputError: no data set, no mask in the folder, an image that is missing or of another size than its
            camera, no points.
    """
    folder = path_of(path)
    if not folder.exists():
        raise InputError(f"path must be an existing data set, got {folder}; give its folder")
    if hold_out is not None and whole_number("--hold-out", hold_out, 0, 2**31) == 1:
        raise InputError(f"--hold-out must be 0 (none), or 2 or more (every n-th view), got {hold_out}")
    random_points = whole_number("--random-points", random_points, 0, MAX_POINTS)
    report = callback("progress", progress) or no_progress
    chosen = Masks(None if masks is None else path_of(masks), flag("alpha_masks", alpha_masks))
    if chosen.folder is not None and not chosen.folder.is_dir():
        raise InputError(f"--masks must be a folder of masks NAME.png, got {chosen.folder}")
    contents = (load_transforms if has_transforms(folder) else _load_colmap)(folder, report, chosen)
    names = [view.name for view in contents.views]
    if chosen.folder is not None and not any(mask_file(chosen.folder, name) for name in names):
        example = names[0] if names else "NAME"
        raise InputError(f"{chosen.folder} must have masks of the images, e.g. {example}.png, got none")
    views, held_out = _divided(contents.views, contents.held_out, hold_out)
    points, colors = contents.points, contents.colors
    if not len(points) and not random_points:
        raise InputError(
            f"{folder} must have initial points, got none; give --random-points 5000, or a model with points"
        )
    dataset = Dataset(str(folder), views, held_out, points, colors, contents.background, contents.boxes)
    return dataset.with_random_points(random_points, seed) if random_points else dataset


def _divided(
    views: Sequence[TrainingView], held_out: Sequence[TrainingView], every: int | None
) -> tuple[tuple[TrainingView, ...], tuple[TrainingView, ...]]:
    if every is None:
        every = 0 if held_out or len(views) < MIN_VIEWS_TO_HOLD_OUT else HOLD_OUT
    if every == 0:
        return tuple(views), tuple(held_out)
    return (
        tuple(view for i, view in enumerate(views) if i % every),
        (*views[::every], *held_out),
    )


def _load_colmap(folder: Path, progress: Progress, masks: Masks) -> DatasetContents:
    model = next((folder / name for name in _MODELS if has_colmap(folder / name)), None)
    if model is None:
        raise InputError(
            f"{folder} must be a data set of COLMAP (sparse/0/cameras.bin and images/) or nerfstudio "
            "(transforms.json), got neither"
        )
    background, boxes = _metadata(folder)
    views, points, colors = _model(folder, model, background, progress, "images", masks)
    held_out: list[TrainingView] = []
    if has_colmap(folder / "test" / "sparse" / "0"):
        test = folder / "test"
        held_out, _, _ = _model(test, test / "sparse" / "0", background, progress, "test images", masks)
    views, held_out = without_markers(views, boxes), without_markers(held_out, boxes)
    matrices = tuple(box.matrix for box in boxes)
    return DatasetContents(views, held_out, points, colors, background, matrices)


def _model(
    folder: Path, model_folder: Path, background: Background, progress: Progress, label: str, masks: Masks
) -> tuple[list[TrainingView], np.ndarray, np.ndarray]:
    model = load_colmap(model_folder)
    views: list[TrainingView] = []
    others: set[tuple[int, int]] = set()
    for i, (name, camera) in enumerate(zip(model.names, model.cameras, strict=True)):
        progress(label, i / len(model.names))
        file = folder / "images" / name
        check_other_image(file, others)
        mask = masks.of(file, name, mask_file(folder / "masks", name))
        views.append(undistorted_view(name, camera, read_on_background(file, background), mask))
    return views, model.points, model.colors


def _metadata(folder: Path) -> tuple[Background, tuple[MarkerBox, ...]]:
    """Background and boxes of the first metadata file in the folder."""
    for name in METADATA:
        file = folder / name
        if file.exists():
            text = read_text(file, "replace")
            try:
                values = from_json(text)
                red, green, blue = np.broadcast_to(
                    np.asarray(values.get("background", 0.0), float), 3
                ).tolist()
            except (ValueError, AttributeError, TypeError, OverflowError):
                raise InputError(
                    f"background of {file} must be one number or three, got {text[:80]!r}"
                ) from None
            return (red, green, blue), read_boxes(file, values.get("boxes", ()))
    return (0.0, 0.0, 0.0), ()
