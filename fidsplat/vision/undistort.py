"""Undistortion: resampling images of a lens to a pinhole camera."""

from functools import lru_cache

import cv2
import numpy as np

from fidsplat.cameras import Camera, Lens, Orthographic
from fidsplat.util.errors import InputError

_NOWHERE = -1e4
"""coordinate of pixels outside the lens's field of view"""


def undistort(image: np.ndarray, camera: Camera, pinhole: Camera) -> np.ndarray:
    """Resample an image to a pinhole at the same position, by bilinear interpolation; 0 outside of the image.

    Args:
        image: (h, w) or (h, w, 3) of uint8 or float32, taken by `camera`.
        pinhole: its pose may be rotated, for instance towards the side of a fisheye image.

    Raises:
        InputError: the image has another size than the camera's, the pinhole is at another position, or the
            camera's rays are parallel.
    """
    if isinstance(camera.lens, Orthographic):
        raise InputError(
            "the camera must have rays from one point, got Orthographic, which has no pinhole equivalent; "
            "use its image unchanged"
        )
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"the image must have the camera's size, {camera.width} x {camera.height} pixels, got "
            f"{image.shape[1]} x {image.shape[0]}; give the camera that took the image"
        )
    if not np.allclose(pinhole.position, camera.position, rtol=0, atol=1e-9):
        raise InputError(
            f"the pinhole must have the position of the image's camera, {camera.position.tolist()}, got "
            f"{pinhole.position.tolist()}"
        )
    rays = pinhole.rays(pinhole.pixel_centers.reshape(-1, 2)) @ pinhole.world_to_camera[:3, :3]
    at = camera.project(camera.position + rays).astype(np.float32) - np.float32(0.5)
    at = np.nan_to_num(at, nan=_NOWHERE).reshape(pinhole.height, pinhole.width, 2)
    return cv2.remap(np.ascontiguousarray(image), at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def undistort_masked(image: np.ndarray, camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undistort an image to a pinhole of the same pose, size and focal length; the table of a lens is cached.

    Returns the image and (h, w) bool: pixels whose samples are all inside the image and its mask (h, w).
    """
    lens = camera.lens
    assert lens is not None  # already undistorted
    x, y = _sample_positions(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, lens)
    counts = cv2.remap(np.where(mask, np.uint8(255), np.uint8(0)), x, y, cv2.INTER_LINEAR)
    return cv2.remap(np.ascontiguousarray(image), x, y, cv2.INTER_LINEAR), counts == 255


@lru_cache(maxsize=2)
def _sample_positions(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, lens: Lens
) -> np.ndarray:
    """Remap table for undistortion, (2, h, w) float32: x and y in the distorted image."""
    at = np.empty((2, height, width), np.float32)
    rays = np.stack([(np.arange(width) + 0.5 - cx) / fx, np.empty(width), np.ones(width)], axis=1)
    for row in range(height):  # row by row, for bounded memory
        rays[:, 1] = (row + 0.5 - cy) / fy
        with np.errstate(over="ignore"):
            at[:, row] = (lens.image(rays) * (fx, fy) + (cx - 0.5, cy - 0.5)).T
    return np.nan_to_num(at, nan=_NOWHERE, posinf=_NOWHERE, neginf=_NOWHERE)
