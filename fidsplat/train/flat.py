"""Views of pictures that lenses took: they are made flat when they are read."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.train.dataset import TrainingView
from fidsplat.vision.undistort import flattened


def flat_view(name: str, camera: Camera, picture: np.ndarray, mask: np.ndarray | None) -> TrainingView:
    """A view to train on. What a camera with a lens took is shown as a pinhole of its focal length sees it,
    and the mask leaves out what that sees beyond the picture.

    Raises InputError as `TrainingView`.
    """
    size = (camera.height, camera.width)
    if camera.lens is not None and picture.shape[:2] == size and (mask is None or mask.shape == size):
        picture, counts = flattened(picture, camera, np.ones(size, bool) if mask is None else mask)
        mask, camera = None if counts.all() else counts, replace(camera, lens=None)
    return TrainingView(name, camera, picture, mask)
