"""What a detector reads in a picture, held against what was placed in the scene."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.markers import Marker
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.images import to_uint8
from fidsplat.vision.pose import marker_pose, pose_error

# modules of ground around a code without which no detector need find it
MARGIN = 1


@dataclass(frozen=True, eq=False)
class Reading:
    """One marker of a scene, and how it was read."""

    placed: PlacedMarker
    truth: np.ndarray
    """(4, 4) camera_from_marker"""
    corners: np.ndarray
    """(4, 2) pixels where the code's corners are, NaN behind the camera"""
    detection: Detection | None
    """None when the marker was not found"""
    pose: np.ndarray | None
    """(4, 4) camera_from_marker from the detected corners"""
    position_error: float | None
    """metres"""
    angle_error: float | None
    """radians"""
    corner_error: float | None
    """pixels, root mean square over the four corners"""

    @property
    def distance(self) -> float:
        """Metres from the camera to the middle of the marker."""
        return float(np.linalg.norm(self.truth[:3, 3]))

    def as_dict(self) -> dict:
        """For JSON: millimetres, degrees, pixels; None where the marker was not found."""
        return {
            "marker": self.placed.marker.spec,
            "label": self.placed.label,
            "found": self.detection is not None,
            "distance_m": self.distance,
            "position_error_mm": None if self.position_error is None else self.position_error * 1e3,
            "angle_error_deg": None if self.angle_error is None else math.degrees(self.angle_error),
            "corner_error_px": self.corner_error,
            "camera_from_marker": None if self.pose is None else self.pose.tolist(),
            "corners": None if self.detection is None else self.detection.corners.tolist(),
        }


def own_code(made: Marker, picture: np.ndarray) -> Detection | None:
    """A marker's code in a picture, (h, w) or (h, w, 3) display values; None where it is not read."""
    families = families_of([made])
    found = detect(to_uint8(picture), families, qr=made.kind == "qr")
    return next((code for code in found if _same(code, made)), None)


def corner_error(code: Detection, corners: np.ndarray) -> float:
    """Pixels between a code's corners and where they are, (4, 2): root mean square over the four."""
    return float(np.sqrt(((code.corners - corners) ** 2).sum(1).mean()))


def read_back(
    detections: Iterable[Detection], markers: Sequence[PlacedMarker], camera: Camera
) -> tuple[list[Reading], list[Detection]]:
    """A Reading for each marker, and the detections that belong to none.

    A detection belongs to a marker of the same kind and id or payload; of several such, the nearest pairs
    go first.
    """
    left = list(detections)
    seen = [camera.project(placed.corners) for placed in markers]
    pairs = [
        (_apart(found.corners, seen[i]), i, found)
        for i, placed in enumerate(markers)
        for found in left
        if _same(found, placed.marker)
    ]
    chosen: dict[int, Detection] = {}
    for _, i, found in sorted(pairs, key=lambda pair: pair[0]):
        if i not in chosen and found in left:
            chosen[i] = found
            left.remove(found)
    return [_reading(placed, seen[i], chosen.get(i), camera) for i, placed in enumerate(markers)], left


def families_of(markers: Iterable[Marker]) -> tuple[str, ...]:
    """Families of those that are tags, each once, for `detect`."""
    tags = (made for made in markers if made.kind in ("apriltag", "aruco"))
    return tuple(dict.fromkeys(f"{tag.kind}:{tag.family}" for tag in tags))


def visible_share(placed: PlacedMarker, camera: Camera, label: np.ndarray) -> float:
    """How much of a marker, one module of its quiet zone included, is in the picture with nothing in front:
    0 to 1.

    Args:
        label: (h, w) int32, the output `label` of the picture.
    """
    rows, columns = placed.marker.bits.shape
    grow = np.array([1 + 2 * MARGIN / columns, 1 + 2 * MARGIN / rows, 1.0])
    outline = (placed.marker.corners * grow) @ placed.pose[:3, :3].T + placed.pose[:3, 3]
    corners = camera.project(outline)
    if not np.isfinite(corners).all():
        return 0.0
    low = np.floor(corners.min(0)).astype(int)
    high = np.ceil(corners.max(0)).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    sides = np.roll(corners, -1, 0) - corners
    turns = [s[0] * (y - c[1]) - s[1] * (x - c[0]) for c, s in zip(corners, sides, strict=True)]
    within = np.all([turn > 0 for turn in turns], axis=0)  # clockwise as printed: seen from the front
    if not within.any():
        return 0.0
    h, w = label.shape
    inside = within & (x > 0) & (y > 0) & (x < w) & (y < h)
    own = label[np.floor(y[inside]).astype(int), np.floor(x[inside]).astype(int)] == placed.label
    return float(own.sum() / within.sum())


def _same(found: Detection, made: Marker) -> bool:
    if found.kind == "qr":  # whose family is its version
        return (found.kind, found.payload) == (made.kind, made.payload)
    return (found.kind, found.family, found.id) == (made.kind, made.family, made.id)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    distance = float(np.linalg.norm(one - other))
    return distance if math.isfinite(distance) else math.inf


def _reading(placed: PlacedMarker, corners: np.ndarray, found: Detection | None, camera: Camera) -> Reading:
    truth = camera.world_to_camera @ placed.pose
    if found is None:
        return Reading(placed, truth, corners, None, None, None, None, None)
    pose = marker_pose(found.corners, placed.marker.size, camera)
    position, angle = pose_error(pose, truth)
    return Reading(placed, truth, corners, found, pose, position, angle, corner_error(found, corners))
