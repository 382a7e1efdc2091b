"""Detection of a scene's markers in an image, compared with their true poses."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.files import pixels_of, to_uint8
from fidsplat.images.tag_dictionaries import parse_family
from fidsplat.markers import Marker
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.util.arguments import invalid
from fidsplat.vision.boards import BOARDS, board_pose
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.truth import MarkerTruth, at_shutter, marker_truth


@dataclass(frozen=True, eq=False)
class Reading(MarkerTruth):
    """One marker of a scene, where it is, and how it was read."""

    detection: Detection | None = None
    """None when the marker was not found"""
    pose: np.ndarray | None = None
    """(4, 4) camera_from_marker from what was detected"""
    position_error: float | None = None
    """metres"""
    angle_error: float | None = None
    """radians"""
    corner_error: float | None = None
    """pixels, root mean square over the four corners"""

    def as_dict(self) -> dict[str, Any]:
        """For JSON: millimetres, degrees, pixels; None where the marker was not found."""
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
    """What `read_back` returns."""

    readings: list[Reading]
    """of each marker of the scene, in its order"""
    others: list[Detection]
    """detected codes that the scene does not have"""


def read_back(
    frame: Mapping[str, np.ndarray] | np.ndarray,
    scene: Scene,
    camera: Camera | None = None,
    families: Iterable[str] | None = None,
) -> ReadBack:
    """Detect every marker of a scene in its image: id, corners, pose, and their errors.

    Boards (charuco, gridboard, aprilgrid) have one pose each, from all detected tags. Drawings and
    images are not looked for.

    Args:
        frame: a `Frame` with `rgb`, and with `label` if `Reading.visible` is to include occlusion; or
            images by name; or (h, w, 3) uint8, or float in [0, 1].
        scene, camera: as of `truth_of`: the truth is where the Frame's own capture has the camera and the
            markers, or the scene's capture for other images.
        families: tag families to look for, see `detect`; default the scene's.

    Raises:
        InputError: no camera, or one of another size than the image.
    """
    if isinstance(frame, Mapping) and "rgb" not in frame:
        raise invalid("frame", "a Frame with rgb, or an array", list(frame))
    image = to_uint8(pixels_of(frame["rgb"] if isinstance(frame, Mapping) else frame))
    label = frame["label"] if isinstance(frame, Mapping) and "label" in frame else None
    camera, markers = at_shutter(frame, scene, camera, image.shape)
    found = detect(image, families_of(placed.marker for placed in markers) if families is None else families)
    codes, left = match(found, markers, camera)
    for number, placed in enumerate(markers):
        if placed.marker.kind in BOARDS:
            codes[number], left = board_pose(image, left, placed, camera)
    readings = [_reading(placed, code, camera, label) for placed, code in zip(markers, codes, strict=True)]
    return ReadBack(readings, left)


def match(
    detections: Iterable[Detection], markers: Sequence[PlacedMarker], camera: Camera
) -> tuple[list[tuple[Detection, np.ndarray] | None], list[Detection]]:
    """For each marker its detection and camera_from_marker, or None; and the detections that belong to none.

    A detection belongs to a marker of the same kind and id or payload; of several such, the nearest pairs
    go first.
    """
    left = list(detections)
    expected = [camera.project(placed.corners) for placed in markers]
    pairs = [
        (_apart(found.corners, expected[i]), i, found)
        for i, placed in enumerate(markers)
        for found in left
        if _same(found, placed.marker)
    ]
    chosen: dict[int, Detection] = {}
    for _, i, found in sorted(pairs, key=lambda pair: pair[0]):
        if i not in chosen and found in left:
            chosen[i] = found
            left.remove(found)
    codes = [
        (chosen[i], marker_pose(chosen[i].corners, placed.marker.size, camera)) if i in chosen else None
        for i, placed in enumerate(markers)
    ]
    return codes, left


def own_code(made: Marker, image: np.ndarray) -> Detection | None:
    """The detection of a marker's code in an image, (h, w) or (h, w, 3) display values; None if not found."""
    found = detect(to_uint8(image), families_of([made]), qr=made.kind == "qr")
    return next((code for code in found if _same(code, made)), None)


def corner_error(code: Detection, corners: np.ndarray) -> float:
    """Pixels between a code's corners and where they are, (4, 2): root mean square over the four."""
    return float(np.sqrt(((code.corners - corners) ** 2).sum(1).mean()))


def families_of(markers: Iterable[Marker]) -> tuple[str, ...]:
    """Families of those that are tags or boards of tags, each once, for `detect`."""
    tags = (made for made in markers if made.kind in ("apriltag", "aruco", *BOARDS))
    return tuple(dict.fromkeys(":".join(parse_family(str(tag.family))) for tag in tags))


def means(readings: Sequence[Reading]) -> dict[str, Any]:
    """How many markers were found of how many that could be, and the means of their errors, as
    `Reading.as_dict` has them; None where none was found. Markers that are not visible (from behind, out
    of the image, occluded) are counted apart, in `not_visible`."""
    could_be = [reading for reading in readings if reading.visible > 0 or reading.detection is not None]
    facts = [reading.as_dict() for reading in could_be if reading.detection is not None]
    keys = ("position_error_mm", "angle_error_deg", "corner_error_px")
    mean = {key: float(np.mean([fact[key] for fact in facts])) if facts else None for key in keys}
    counts = {"markers": len(could_be), "found": len(facts), "not_visible": len(readings) - len(could_be)}
    return counts | mean


def _same(found: Detection, made: Marker) -> bool:
    if found.kind == "qr":  # whose family is its version
        return (found.kind, found.payload) == (made.kind, made.payload)
    return (found.kind, found.family, found.id) == (made.kind, made.family, made.id)


def _apart(one: np.ndarray, other: np.ndarray) -> float:
    distance = float(np.linalg.norm(one - other))
    return distance if math.isfinite(distance) else math.inf


def _reading(
    placed: PlacedMarker, code: tuple[Detection, np.ndarray] | None, camera: Camera, label: np.ndarray | None
) -> Reading:
    truth = marker_truth(placed, camera, label)
    reading = Reading(**{field.name: getattr(truth, field.name) for field in fields(truth)})
    if code is None:
        return reading
    found, pose = code
    position, angle = pose_error(pose, truth.truth)
    return replace(
        reading,
        detection=found,
        pose=pose,
        position_error=position,
        angle_error=angle,
        corner_error=corner_error(found, truth.corners),
    )
