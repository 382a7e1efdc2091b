"""Disparity of a rectified image pair: semi-global matching with a least-squares refinement.

OpenCV's StereoSGBM (Hirschmueller 2008) finds the matches. Its interpolation between whole disparities is
biased by up to a quarter of a pixel, so each match is refined by the least squares of its block (Lucas and
Kanade 1981).
"""

from __future__ import annotations

import cv2
import numpy as np

BLOCK = 7
"""edge of the matched blocks in pixels"""

STEPS = 4
"""steps of the refinement"""

SMOOTH = 0.8
"""standard deviation in pixels of the Gaussian filter before the refinement"""


def disparity_of(left: np.ndarray, right: np.ndarray, max_disparity: int) -> np.ndarray:
    """Disparities (h, w) float32 [px] of a rectified pair of grey images (h, w) uint8; 0: no match.

    max_disparity: in pixels, a multiple of 16. Matches must be unique, consistent between left and right, and
    belong to a smooth region.
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=max_disparity,
        blockSize=BLOCK,
        P1=2 * BLOCK**2,
        P2=16 * BLOCK**2,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=60,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    # padding on the left, so that near surfaces at the left edge are matched too
    padded = [
        cv2.copyMakeBorder(image, 0, 0, max_disparity, 0, cv2.BORDER_REPLICATE) for image in (left, right)
    ]
    disparity = matcher.compute(*padded)[:, max_disparity:].astype(np.float32) / 16
    return _refined(left.astype(np.float32), right.astype(np.float32), np.maximum(disparity, 0))


def _refined(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Refine disparities by minimising the squared differences of each block."""
    left, right = (cv2.GaussianBlur(image, (0, 0), SMOOTH) for image in (left, right))
    valid, better = disparity > 0, disparity
    columns = np.arange(left.shape[1], dtype=np.float32)
    for _ in range(STEPS):
        warped, gradient = _shifted_rows(right, columns - better)
        gradient = gradient * valid
        # one disparity per block, with images linearised at the disparity of each pixel
        below = cv2.boxFilter(gradient**2, -1, (BLOCK, BLOCK))
        above = cv2.boxFilter(gradient**2 * better - gradient * (left - warped), -1, (BLOCK, BLOCK))
        new = above / np.maximum(below, 1e-6)
        better = np.where(valid & (np.abs(new - disparity) < 1), new, disparity).astype(np.float32)
    return better


def _shifted_rows(image: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and horizontal derivatives of an image at columns (h, w) of its rows, by cubic Hermite
    interpolation (`cv2.remap` rounds positions to 1/32 pixel)."""
    last = image.shape[1] - 1
    first = np.floor(at)
    t, rows = (at - first).astype(np.float32), np.arange(len(image))[:, None]
    a, b, c, d = (image[rows, np.clip(first + k, 0, last).astype(int)] for k in (-1, 0, 1, 2))
    one, two, three = (c - a) / 2, a - 2.5 * b + 2 * c - d / 2, 1.5 * (b - c) + (d - a) / 2
    return b + t * (one + t * (two + t * three)), one + t * (2 * two + t * 3 * three)
