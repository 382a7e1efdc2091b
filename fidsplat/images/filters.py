"""Image filters: grey levels and defocus."""

from __future__ import annotations

import math

import cv2
import numpy as np


def grey_of(image: np.ndarray) -> np.ndarray:
    """Grey levels (h, w) uint8 of an image (h, w, 3) uint8, with the weights of BT.601."""
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def defocused(image: np.ndarray, radius: float) -> np.ndarray:
    """An image blurred by a disk with a radius in pixels, in display values."""
    if radius <= 0:
        return image
    half = math.ceil(radius)
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    # weights at the edge of the disk are the covered fraction of a pixel's width
    disk = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1)
    return cv2.filter2D(image, -1, disk / disk.sum(), borderType=cv2.BORDER_REPLICATE)
