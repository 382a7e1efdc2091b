"""Boxes around the markers of a data set: training leaves no splats in them and none in front of them.

Densification prunes splats in boxes and near the front of markers. In the training images, the background
colour replaces visible markers. The views have different background colours, so that only transparent splats
match all images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.train.dataset import TrainingView
from fidsplat.util.errors import InputError

GREYS = (0.0, 1.0, 0.0, 0.0)
"""background display values, cycled through by view index. White in every second view costs 0.4 dB in
held-out views; these have even indices if every second, fourth or eighth view is held out"""
EDGE = 1.5
"""width [px] of the marker's rim that stays in the image, so that no gap remains around the marker"""


FRONT = 6.0
"""distance in front of a marker, in half thicknesses of its box, within which splats are removed"""


@dataclass(frozen=True, eq=False)
class MarkerBox:
    """A box around a marker."""

    matrix: np.ndarray
    """(4, 4) from the cube [-1, 1]^3 to the box; the marker is in its plane z = 0 and faces -z"""
    visible: frozenset[str]
    """names of the views in which nothing occludes the marker"""


def read_boxes(file: Path, entries: Any) -> tuple[MarkerBox, ...]:
    """Parse the field `boxes` of a data set's metadata: a list of {"matrix": 4 x 4, "visible": view names}.

    Raises InputError.
    """
    try:
        boxes = tuple(
            MarkerBox(np.array(entry["matrix"], float).reshape(4, 4), frozenset(map(str, entry["visible"])))
            for entry in entries
        )
        if not all(np.isfinite(box.matrix).all() and abs(np.linalg.det(box.matrix)) > 0 for box in boxes):
            raise ValueError
    except (ValueError, TypeError, KeyError):
        raise InputError(
            f'boxes of {file} must be a list of {{"matrix": invertible, 4 x 4, "visible": view names}}, got '
            f"{str(entries)[:80]!r}; run the capture again"
        ) from None
    return boxes


def outside_boxes(points: np.ndarray, matrices: Sequence[np.ndarray]) -> np.ndarray:
    """Mask (n,) of the points (n, 3) that are neither in a box nor up to `FRONT` in front of it."""
    outside = np.ones(len(points), bool)
    for box in matrices:
        local = np.linalg.solve(box[:3, :3], (points - box[:3, 3]).T)
        outside &= (np.abs(local[:2]) > 1).any(0) | (local[2] > 1) | (local[2] < -FRONT)
    return outside


def marker_mask(box: np.ndarray, camera: Camera, margin: float) -> np.ndarray:
    """Mask (h, w) bool of the marker in a box, dilated by `margin` pixels; all False if it faces away."""
    size = (camera.height, camera.width)
    if not box[:3, 2] @ (box[:3, 3] - camera.position) > 0:
        return np.zeros(size, bool)
    corners = camera.project(np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ box[:3, :2].T + box[:3, 3])
    if not np.isfinite(corners).all():
        return np.zeros(size, bool)
    x, y = np.moveaxis(camera.pixel_centers, -1, 0)
    inside = np.ones(size, bool)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
        length = max(float(np.hypot(x1 - x0, y1 - y0)), 1e-9)
        # clockwise in the image, since y points down
        inside &= (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > -margin * length
    return inside


def without_markers(views: Sequence[TrainingView], boxes: Sequence[MarkerBox]) -> list[TrainingView]:
    """Replace visible markers in the images by the background colour; mask markers that may be occluded."""
    if not boxes:
        return list(views)
    masks = []
    for number, view in enumerate(views):
        grey = GREYS[number % len(GREYS)]
        image = view.image.copy()
        mask = np.ones(image.shape[:2], bool) if view.mask is None else view.mask.copy()
        for box in boxes:
            region = marker_mask(box.matrix, view.camera, EDGE)
            if view.name in box.visible:
                image[marker_mask(box.matrix, view.camera, -EDGE)] = round(255 * grey)
                mask |= region
            else:
                mask &= ~region
        masks.append(replace(view, image=image, mask=mask, background=(grey,) * 3))
    return masks
