"""Masks of training images: from files, from the alpha channel, and at the edges of undistorted images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.files import read_image, read_rgba
from fidsplat.train.dataset import DRAW_MASK, TrainingView
from fidsplat.util.errors import InputError
from fidsplat.vision.undistort import undistort_masked

_OPAQUE = 128
"""minimum alpha (uint8) of pixels in the loss, with `Masks.alpha`"""


@dataclass(frozen=True)
class Masks:
    """Sources of masks, (h, w) bool, False for ignored pixels, in addition to those of the data set."""

    folder: Path | None = None
    """folder of masks"""
    alpha: bool = False
    """whether the loss ignores transparent pixels; otherwise they show the background"""

    def of(self, image: Path, name: str, given: Path | None) -> np.ndarray | None:
        """The mask of an image file, of the pixels that no source ignores; None if it has none.

        Args:
            name: name of the image in the data set.
            given: mask file of the data set.

        Raises InputError for masks of different sizes.
        """
        files = [given, None if self.folder is None else mask_file(self.folder, name)]
        masks = [read_image(file).max(axis=2) > 0 for file in files if file is not None]
        if self.alpha:
            masks.append(read_rgba(image)[:, :, 3] >= _OPAQUE)
        sizes = list(dict.fromkeys(f"{mask.shape[1]} x {mask.shape[0]}" for mask in masks))
        if len(sizes) > 1:
            raise InputError(
                f"the masks of {name} must have the size of its image, got {' and '.join(sizes)}; {DRAW_MASK}"
            )
        return np.logical_and.reduce(masks) if masks else None


def mask_file(folder: Path, name: str) -> Path | None:
    """Path of the mask of an image in a folder, or None: COLMAP appends .png to the name of the image, other
    programs replace its suffix."""
    image = folder / name
    candidates = (image.with_name(f"{image.name}.png"), image.with_suffix(".png"))
    return next((candidate for candidate in candidates if candidate.is_file()), None)


def undistorted_view(name: str, camera: Camera, image: np.ndarray, mask: np.ndarray | None) -> TrainingView:
    """Make a training view; a photograph with lens distortion is resampled to a pinhole camera of the same
    focal length, and the mask excludes pixels outside the photograph.

    Raises InputError if camera, image and mask do not match.
    """
    size = (camera.height, camera.width)
    if camera.lens is not None and image.shape[:2] == size and (mask is None or mask.shape == size):
        image, inside = undistort_masked(image, camera, np.ones(size, bool) if mask is None else mask)
        mask, camera = None if inside.all() else inside, replace(camera, lens=None)
    return TrainingView(name, camera, image, mask)
