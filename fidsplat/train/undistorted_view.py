"""Undistortion of training photographs when they are read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.train.dataset import TrainingView
from fidsplat.vision.undistort import undistort_masked


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
