"""Gaussian image pyramids for coarse-to-fine alignment."""

from __future__ import annotations

import cv2
import numpy as np


def resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Mean of an image (h, w) or (h, w, c) over the pixels of a smaller one, float32."""
    image = np.ascontiguousarray(image, np.float32)
    if image.shape[:2] == (height, width):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA).reshape(
        height, width, *image.shape[2:]
    )


def smoothed(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of an image (h, w, c) float32; sigma in pixels, 0 for none."""
    if sigma == 0:
        return image
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE).reshape(image.shape)
