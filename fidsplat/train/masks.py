"""Masks of training images: files of a folder, and the alpha channel of the images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.images.files import read_image, read_rgba

_OPAQUE = 128
"""alpha from which a pixel counts, with `alpha`"""


@dataclass(frozen=True)
class Masks:
    """Sources of masks, (h, w) bool, False for ignored pixels."""

    folder: Path | None = None
    """folder of masks, instead of those of the data set; None: those of the data set"""
    alpha: bool = False
    """whether transparent pixels are ignored, instead of showing the background"""

    def of(self, image: Path, name: str, given: Path | None) -> np.ndarray | None:
        """The mask of an image file; None if it has none.

        Args:
            name: name of the image in the data set.
            given: mask file of the data set.
        """
        file = given if self.folder is None else mask_file(self.folder, name)
        mask = None if file is None else read_image(file).max(axis=2) > 0
        if not self.alpha:
            return mask
        opaque = read_rgba(image)[:, :, 3] >= _OPAQUE
        if mask is not None and mask.shape == opaque.shape:
            return mask & opaque
        return opaque if mask is None else mask


def mask_file(folder: Path, name: str) -> Path | None:
    """The mask of an image in a folder: COLMAP appends .png to the name of the image, others replace its
    suffix."""
    image = folder / name
    candidates = (image.with_name(f"{image.name}.png"), image.with_suffix(".png"))
    return next((one for one in candidates if one.is_file()), None)
