"""Camera calibration by OpenCV from views of a ChArUco board, and its errors against a known camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye
from fidsplat.cameras.foreign import PIXEL_OFFSET
from fidsplat.images.tag_dictionaries import families, parse_family
from fidsplat.markers import Marker, parse_spec
from fidsplat.markers.boards import BoardSpec
from fidsplat.splats.rotations import nearest_rotation
from fidsplat.util.arguments import invalid
from fidsplat.util.errors import InputError
from fidsplat.vision.boards import ENOUGH, chess_corners

ESTIMATED: dict[type, tuple[str, ...]] = {
    BrownConrady: ("k1", "k2", "p1", "p2", "k3"),
    Fisheye: ("k1", "k2", "k3", "k4"),
}
"""estimated coefficients of each lens, in OpenCV's order"""
GRID = 24
"""points of an image along each edge at which projections are compared"""


@dataclass(frozen=True)
class BoardView:
    """Corners of a board in one image."""

    points: np.ndarray
    """(n, 2) metres on the board, x right, y down from its top left corner"""
    corners: np.ndarray
    """(n, 2) pixels"""


def find_board(image: np.ndarray, board: Marker) -> BoardView | None:
    """Detect the corners of a ChArUco board, (h, w, 3) uint8; None if fewer than `ENOUGH` are found.

    Raises:
        InputError: a marker that is not a ChArUco board.
    """
    spec = parse_spec(board.spec)
    if not isinstance(spec, BoardSpec) or spec.kind != "charuco":
        raise invalid("board", "a ChArUco board, e.g. charuco:9x6:5x5_100", board.spec)
    kind, family = parse_family(spec.family or "")
    squares, corners = chess_corners(image, spec, families(kind)[family].size)
    return BoardView(squares * board.module, corners) if len(corners) >= ENOUGH else None


def calibrate(views: Sequence[BoardView], start: Camera) -> Camera:
    """Estimate the intrinsics of a camera by `cv2.calibrateCamera` or `cv2.fisheye.calibrate`.

    start: camera of the image size and the lens model: none, `BrownConrady` (k1, k2, p1, p2, k3) or
    `Fisheye`; its intrinsics are not used.

    Raises:
        InputError: fewer than three views, another lens, or views that OpenCV cannot calibrate from.
    """
    if len(views) < 3:
        raise InputError(f"calibration must have at least 3 views of the board, got {len(views)}; add views")
    if start.lens is not None and type(start.lens) not in ESTIMATED:
        raise invalid("the lens of a calibration", "none, brown_conrady or fisheye", start.lens.kind)
    points = [np.pad(view.points, ((0, 0), (0, 1))).astype(np.float32)[:, None] for view in views]
    corners = [(view.corners - PIXEL_OFFSET).astype(np.float32)[:, None] for view in views]
    size = (start.width, start.height)
    try:
        if isinstance(start.lens, Fisheye):
            # OpenCV 4 has the flags in cv2.fisheye
            flags = sum(getattr(cv2.fisheye, name, None) or getattr(cv2, name) for name in _FISHEYE_FLAGS)
            rows = [[array.astype(float).swapaxes(0, 1) for array in given] for given in (points, corners)]
            _, matrix, values, *_ = cv2.fisheye.calibrate(  # type: ignore[call-overload]
                *rows, size, np.eye(3), np.zeros((4, 1)), flags=flags
            )
        else:
            fixed = 0 if start.lens else sum(getattr(cv2, name) for name in _PINHOLE_FLAGS)
            _, matrix, values, *_ = cv2.calibrateCamera(  # type: ignore[call-overload]
                points, corners, size, None, None, flags=fixed
            )
    except cv2.error as error:
        raise InputError(
            f"views must show the board at different tilts, got views that OpenCV cannot calibrate "
            f"({error.err}); add views at other tilts"
        ) from None
    lens = None
    if start.lens is not None:
        kind: Any = type(start.lens)
        lens = kind(**dict(zip(ESTIMATED[kind], np.ravel(values).tolist(), strict=False)))
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + PIXEL_OFFSET, matrix[1, 2] + PIXEL_OFFSET
    return Camera.pinhole(*size, *map(float, (fx, fy, cx, cy)), lens=lens)


_FISHEYE_FLAGS = ("CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
_PINHOLE_FLAGS = ("CALIB_FIX_K1", "CALIB_FIX_K2", "CALIB_FIX_K3", "CALIB_ZERO_TANGENT_DIST")


def parameters(camera: Camera) -> dict[str, float]:
    """Intrinsics and estimated lens coefficients by name; the centre of the first pixel is at 0.5."""
    values = {name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")}
    lens = camera.lens
    return values | {name: getattr(lens, name) for name in ESTIMATED.get(type(lens), ())}


def projection_errors(estimate: Camera, truth: Camera) -> np.ndarray:
    """Distances in pixels between the projections of two cameras, of rays through a grid of the image.

    The rotation between the cameras that fits best is removed, since poses absorb it (the "implied rotation"
    of mrcal). Rays that one of the cameras does not have are left out.
    """
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * edge for edge in (truth.width, truth.height)))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    true, other = (_directions(camera, pixels) for camera in (truth, estimate))
    known = np.isfinite(true).all(1) & np.isfinite(other).all(1)
    rotation = nearest_rotation(other[known].T @ true[known])
    projected = estimate.with_pose(np.eye(4)).project(true[known] @ rotation.T)
    errors = np.linalg.norm(projected - pixels[known], axis=1)
    return errors[np.isfinite(errors)]


def _directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    rays = camera.rays(pixels)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
