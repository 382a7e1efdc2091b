"""Detection of a scene's markers in an image, and errors of their poses."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.files import pixels_of, to_uint8
from fidsplat.images.tag_dictionaries import parse_family
from fidsplat.markers import Marker
from fidsplat.markers.kinds import detectors
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.util.arguments import invalid
from fidsplat.vision.boards import BOARDS, board_pose
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.truth import MarkerTruth, at_shutter, marker_truths


@dataclass(frozen=True, eq=False)
class Reading(MarkerTruth):
    """True and estimated pose of a marker, with their difference."""

    detection: Detection | None = None
    """None if the marker was not detected"""
    pose: np.ndarray | None = None
    """(4, 4) estimated camera_from_marker"""
    position_error: float | None = None
    """metres"""
    angle_error: float | None = None
    """radians"""
    corner_error: float | None = None
    """pixels, root mean square over the four corners"""

    def as_dict(self) -> dict[str, Any]:
        """Values for JSON, in millimetres, degrees and pixels; None if the marker was not detected."""
        return {
            "marker": self.placed.marker.spec,
            "label": self.placed.label,
            "found": self.detection is not None,
            "visible": self.visible,
            "box": self.box,
            "distance_m": self.distance,
            "tilt_deg": math.degrees(self.tilt),
            "position_error_mm": None if self.position_error is None else self.position_error * 1e3,
            "angle_error_deg": None if self.angle_error is None else math.degrees(self.angle_error),
            "corner_error_px": self.corner_error,
            "camera_from_marker": None if self.pose is None else self.pose.tolist(),
            "corners": None if self.detection is None else self.detection.corners.tolist(),
        }


class ReadBack(NamedTuple):
    """Result of `read_back`: readings of the scene's markers, and other detections."""

    readings: list[Reading]
    """one reading for each marker of the scene, in order"""
    others: list[Detection]
    """detected codes that are not in the scene"""


def read_back(
    frame: Mapping[str, np.ndarray] | np.ndarray,
    scene: Scene,
    camera: Camera | None = None,
    families: Iterable[str] | None = None,
) -> ReadBack:
    """Detect the markers of a scene in its image, and compare corners and poses with the truth.

    Boards (charuco, gridboard, aprilgrid) have one pose each, from all detected tags. Drawings and images are
    not detected.

    Args:
        frame: a `Frame` with `rgb`, and with `label` if `Reading.visible` is to include occlusion; or
            images by name; or (h, w, 3) uint8, or float in [0, 1].
        scene, camera: as in `truth_of`: the poses of camera and markers are those of the frame's capture, or
            of the scene's capture for other images.
        families: tag families to detect, see `detect`; by default those of the scene's markers.

    Raises:
        InputError: no camera, or one of another size than the image.
    """
    if isinstance(frame, Mapping) and "rgb" not in frame:
        raise invalid("frame", "a Frame with rgb, or an array", list(frame))
    image = to_uint8(pixels_of(frame["rgb"] if isinstance(frame, Mapping) else frame))
    label = frame["label"] if isinstance(frame, Mapping) and "label" in frame else None
    camera, markers = at_shutter(frame, scene, camera, image.shape)
    detections = detect(
        image, families_of(placed.marker for placed in markers) if families is None else families
    )
    codes, left = match(detections, markers, camera)
    for number, placed in enumerate(markers):
        if placed.marker.kind in BOARDS:
            codes[number], left = board_pose(image, left, placed, camera)
    readings = [_reading(placed, code, camera, label) for placed, code in zip(markers, codes, strict=True)]
    return ReadBack(readings, left)


def match(
    detections: Iterable[Detection], markers: Sequence[PlacedMarker], camera: Camera
) -> tuple[list[tuple[Detection, np.ndarray] | None], list[Detection]]:
    """Assign detections to markers.

    A detection is assigned to a marker of the same kind and id or payload, nearest pairs first. Returns for
    each marker the detection and camera_from_marker, or None, and the unassigned detections.
    """
    left = list(detections)
    expected = [camera.project(placed.corners) for placed in markers]
    pairs = [
        (_distance(code.corners, expected[i]), i, code)
        for i, placed in enumerate(markers)
        for code in left
        if content_of(code) == content_of(placed.marker)
    ]
    chosen: dict[int, Detection] = {}
    for _, i, code in sorted(pairs, key=lambda pair: pair[0]):
        if i not in chosen and code in left:
            chosen[i] = code
            left.remove(code)
    codes = [
        (chosen[i], marker_pose(chosen[i].corners, placed.marker.size, camera)) if i in chosen else None
        for i, placed in enumerate(markers)
    ]
    return codes, left


def detect_marker(marker: Marker, image: np.ndarray) -> Detection | None:
    """Detect a marker's code in an image, (h, w) or (h, w, 3) display values; None if not found."""
    detections = detect(to_uint8(image), families_of([marker]), qr=marker.kind == "qr")
    return next((code for code in detections if content_of(code) == content_of(marker)), None)


def corner_error(code: Detection, corners: np.ndarray) -> float:
    """Root mean square distance in pixels between the corners of a detection and the true ones (4, 2)."""
    return float(np.sqrt(((code.corners - corners) ** 2).sum(1).mean()))


def families_of(markers: Iterable[Marker]) -> tuple[str, ...]:
    """Distinct tag families of markers, and kinds with a detector of another package, for `detect`."""
    markers, hooks = list(markers), detectors()
    tags = (made for made in markers if made.kind in ("apriltag", "aruco", *BOARDS))
    names = [":".join(parse_family(str(tag.family))) for tag in tags]
    return tuple(dict.fromkeys((*names, *(made.kind for made in markers if made.kind in hooks))))


def means(readings: Sequence[Reading]) -> dict[str, Any]:
    """Numbers of found and missed markers, and means of the errors of `Reading.as_dict`; None if none was
    found.

    Markers that are not visible (from behind, outside of the image, occluded) count as `not_visible`.
    """
    could_be = [reading for reading in readings if reading.visible > 0 or reading.detection is not None]
    facts = [reading.as_dict() for reading in could_be if reading.detection is not None]
    keys = ("position_error_mm", "angle_error_deg", "corner_error_px")
    mean = {key: float(np.mean([fact[key] for fact in facts])) if facts else None for key in keys}
    counts = {"markers": len(could_be), "found": len(facts), "not_visible": len(readings) - len(could_be)}
    return counts | mean


def content_of(code: Detection | Marker) -> tuple:
    """Kind and content of a code, equal for a marker and its detection."""
    if code.id is None:  # the family of a QR code is its version
        return code.kind, code.payload
    return code.kind, code.family, code.id


def _distance(one: np.ndarray, other: np.ndarray) -> float:
    distance = float(np.linalg.norm(one - other))
    return distance if math.isfinite(distance) else math.inf


def _reading(
    placed: PlacedMarker, code: tuple[Detection, np.ndarray] | None, camera: Camera, label: np.ndarray | None
) -> Reading:
    (truth,) = marker_truths([placed], camera, label)
    reading = Reading(**{field.name: getattr(truth, field.name) for field in fields(truth)})
    if code is None:
        return reading
    detection, pose = code
    position, angle = pose_error(pose, truth.truth)
    return replace(
        reading,
        detection=detection,
        pose=pose,
        position_error=position,
        angle_error=angle,
        corner_error=corner_error(detection, truth.corners),
    )
