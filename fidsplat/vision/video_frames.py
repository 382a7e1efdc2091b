"""Selection of a video's frames for structure from motion, by sharpness and motion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from fidsplat.util.arguments import whole_number

WIDTH = 480
"""pixels: largest width of the image in which sharpness and motion are measured"""
_CORNERS, _QUALITY, _APART = 200, 0.01, 8
"""number of tracked corners, their minimum quality relative to the best, and distance in pixels"""
STEP, FEW = 0.02, 20
"""motion between chosen frames as a fraction of the image's width; number of frames below which it is less"""
LOST = 0.3
"""motion of a pair of frames with too few tracked corners"""
_MIN_TRACKED = 8


def measure_frames(frames: Iterable[np.ndarray]) -> Iterator[tuple[float, float]]:
    """Sharpness of each frame (h, w, 3) uint8, and its motion since the one before.

    Sharpness is the variance of the Laplacian relative to that of the grey values; motion is the median
    displacement of tracked corners (Lucas and Kanade 1981), as a fraction of the image's width.
    """
    before: np.ndarray | None = None
    for frame in frames:
        grey = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        if grey.shape[1] > WIDTH:
            height = max(1, round(grey.shape[0] * WIDTH / grey.shape[1]))
            grey = cv2.resize(grey, (WIDTH, height), interpolation=cv2.INTER_AREA)
        spread = float(grey.var())
        sharpness = float(cv2.Laplacian(grey, cv2.CV_64F).var()) / spread if spread > 0 else 0.0
        yield sharpness, 0.0 if before is None else _motion(before, grey)
        before = grey


def _motion(before: np.ndarray, after: np.ndarray) -> float:
    corners = cv2.goodFeaturesToTrack(before, _CORNERS, _QUALITY, _APART)
    if corners is None or len(corners) < _MIN_TRACKED:
        return LOST
    moved, status, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, np.empty_like(corners))
    tracked = status.ravel() > 0
    if tracked.sum() < max(_MIN_TRACKED, len(corners) // 4):
        return LOST
    return float(np.median(np.linalg.norm((moved - corners)[tracked, 0], axis=1))) / before.shape[1]


def choose_frames(sharpness: np.ndarray, motion: np.ndarray, count: int) -> list[int]:
    """Numbers of the selected frames: the accumulated motion is divided into at most `count` intervals of
    equal length, `STEP` or less, and the sharpest frame of each interval is selected.

    Fewer than three for a camera that does not move.
    """
    path, count = np.cumsum(motion), whole_number("the number of frames", count, 3, 100_000)
    parts = 1 + int(path[-1] / STEP)
    parts = min(count, max(FEW, parts)) if parts >= 3 else 1
    part = np.minimum((path / max(path[-1], 1e-9) * parts).astype(int), parts - 1)
    return sorted(
        int(max(np.flatnonzero(part == number), key=lambda i: sharpness[i])) for number in np.unique(part)
    )
