"""Gaussian image pyramids for coarse-to-fine alignment."""

from __future__ import annotations

import math

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


def taps_of(sigma: float) -> np.ndarray:
    """(r + 1,) float32: upper half of the taps of a Gaussian; sigma in pixels, 0 for no blur."""
    radius = math.ceil(2.5 * sigma)
    return cv2.getGaussianKernel(2 * radius + 1, max(sigma, 1e-3)).astype(np.float32)[radius:, 0]


def convolved(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
    """Convolution of an image (h, w, c) float32 along both axes with symmetric taps, given by their upper
    half (r + 1,). The border is repeated."""
    if len(taps) == 1:
        return image
    both = np.concatenate([taps[:0:-1], taps])
    return cv2.sepFilter2D(image, -1, both, both, borderType=cv2.BORDER_REPLICATE).reshape(image.shape)


def smoothed(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of an image (h, w, c) float32; sigma in pixels, 0 for none."""
    return convolved(image, taps_of(sigma))
