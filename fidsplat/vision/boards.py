"""Pose of a board of tags from all detected tags."""

from collections.abc import Iterable

import cv2
import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.tag_dictionaries import families, parse_family, predefined
from fidsplat.markers.boards import GAP, BoardSpec, tag_positions
from fidsplat.markers.kinds import parse_spec
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.detect import Detection
from fidsplat.vision.pose import plane_pose

BOARDS = ("charuco", "gridboard", "aprilgrid")
"""kinds of markers that are boards"""

ENOUGH = 6
"""Minimum number of chessboard corners for the pose of a ChArUco board; with fewer its tags are used."""


def board_pose(
    image: np.ndarray, tags: Iterable[Detection], placed: PlacedMarker, camera: Camera
) -> tuple[tuple[Detection, np.ndarray] | None, list[Detection]]:
    """Combine the tags of a board to one detection with projected corners and camera_from_marker (4, 4).

    Returns the detection and pose, or None, and the tags of other markers.

    image: (h, w, 3) uint8. tags: detections in it; if several have the same id, the nearest to the true
    position is used.
    """
    marker, left = placed.marker, list(tags)
    spec = parse_spec(marker.spec)
    assert isinstance(spec, BoardSpec)
    kind, family = parse_family(spec.family or "")
    side = families(kind)[family].size
    origin = marker.flat_corners[0]
    points, observed = [], []
    for number, (y, x) in enumerate(tag_positions(spec, side)):
        matches = [tag for tag in left if (tag.kind, tag.family, tag.id) == (kind, family, number)]
        corners = np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)], float)
        where = origin + corners * marker.module
        if matches:
            true = camera.project(marker.points(where) @ placed.pose[:3, :3].T + placed.pose[:3, 3])
            tag = min(matches, key=lambda tag: np.nan_to_num(np.linalg.norm(tag.corners - true), nan=np.inf))
            left.remove(tag)
            points.append(where)
            observed.append(tag.corners)
    if not points:
        return None, left
    at, on = np.concatenate(points), np.concatenate(observed)
    if spec.kind == "charuco":
        squares, corners = chess_corners(image, spec, side)
        if len(corners) >= ENOUGH:
            at, on = origin + squares * marker.module, corners
    pose = plane_pose(at, on, camera)
    if not np.isfinite(pose).all():
        return None, left
    standing = camera.with_pose(np.eye(4))
    corners = standing.project(np.pad(marker.flat_corners, ((0, 0), (0, 1))) @ pose[:3, :3].T + pose[:3, 3])
    text = f"{spec.columns}x{spec.rows}:{family}"
    return (Detection(spec.kind, family, None, text, corners), pose), left


def chess_corners(image: np.ndarray, spec: BoardSpec, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Chessboard corners of a ChArUco board detected by OpenCV: (n, 2) modules and (n, 2) pixels."""
    square = side + GAP
    dictionary = predefined(*parse_family(spec.family or ""))
    board = cv2.aruco.CharucoBoard((spec.columns, spec.rows), square, side, dictionary)
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
    if ids is None or corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    row, column = np.divmod(np.asarray(ids).ravel(), spec.columns - 1)
    # OpenCV's origin is the centre of the first pixel
    return np.column_stack([column + 1, row + 1]) * float(square), np.asarray(corners).reshape(-1, 2) + 0.5
