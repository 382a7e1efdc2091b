"""Initial poses for localisation: from detected markers, and from the most similar of rendered views."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.images.files import to_uint8
from fidsplat.scenes import Scene
from fidsplat.vision.boards import BOARDS
from fidsplat.vision.detect import detect
from fidsplat.vision.pose import marker_pose, points_pose
from fidsplat.vision.pyramid import resized, smoothed
from fidsplat.vision.readback import content_of, families_of

DESCRIPTOR_WIDTH = 32
"""width in pixels of the descriptor of a view"""
DESCRIPTOR_BLUR = 1.0


@dataclass(frozen=True, eq=False)
class DetectedMarkers:
    """Markers of a scene in an image, and the pose of the camera that they determine."""

    camera: Camera
    names: list[str]
    points: np.ndarray
    """(n, 3) corners in the world"""
    corners: np.ndarray
    """(n, 2) detected corners, pixels"""

    def error(self, camera: Camera) -> float:
        """Root mean square of the angles [rad] between detected and projected corners; infinite behind the
        camera."""
        apart = (camera.project(self.points) - self.corners) / (camera.fx, camera.fy)
        error = float(np.sqrt((apart**2).sum(1).mean()))
        return error if np.isfinite(error) else np.inf


def pose_of_markers(image: np.ndarray, scene: Scene, camera: Camera) -> DetectedMarkers | None:
    """Estimate the pose of a camera from detected markers of a scene; None without any.

    Tags and QR codes whose content occurs once in the scene are used.
    """
    markers = [placed for placed in scene.markers if placed.marker.kind not in BOARDS]
    if not markers:
        return None
    contents = [content_of(placed.marker) for placed in markers]
    known = {
        content: placed
        for content, placed in zip(contents, markers, strict=True)
        if contents.count(content) == 1
    }
    qr = any(placed.marker.kind == "qr" for placed in markers)
    detections = detect(to_uint8(image), families_of(placed.marker for placed in markers), qr=qr)
    pairs = [(code, known[content_of(code)]) for code in detections if content_of(code) in known]
    if not pairs:
        return None
    points = np.concatenate([placed.corners for _, placed in pairs])
    corners = np.concatenate([code.corners for code, _ in pairs])
    if len(pairs) == 1:
        code, placed = pairs[0]
        pose = marker_pose(code.corners, placed.marker.size, camera) @ np.linalg.inv(placed.pose)
    else:
        pose = points_pose(points, corners, camera)
    if not np.isfinite(pose).all():
        return None
    return DetectedMarkers(camera.with_pose(pose), [code.name for code, _ in pairs], points, corners)


def repeated_markers(scene: Scene) -> list[str]:
    """Contents of markers that occur more than once in a scene, and do not determine a pose."""
    markers = [placed.marker for placed in scene.markers if placed.marker.kind not in BOARDS]
    counts = Counter(map(content_of, markers))
    return list(dict.fromkeys(marker.spec for marker in markers if counts[content_of(marker)] > 1))


def most_similar(
    image: np.ndarray,
    camera: Camera,
    candidates: Sequence[Camera],
    render: Callable[[list[Camera]], np.ndarray],
    count: int,
) -> list[Camera]:
    """The candidates whose rendered views are most similar to an image, best first.

    The similarity is the correlation of small blurred images by channel, which does not depend on exposure
    and white balance.

    Args:
        image: (h, w, c) display values.
        camera: camera of the image.
        render: renders cameras, (n, h, w, 3).
    """
    width = min(DESCRIPTOR_WIDTH, camera.width)
    height = max(2, round(camera.height * width / camera.width))
    double = camera.resampled(2 * width, 2 * height)
    views = render([double.with_pose(candidate.world_to_camera) for candidate in candidates])
    if image.shape[2] == 1:
        views = views.mean(axis=3, keepdims=True)
    rendered = np.array([_descriptor(view, width, height) for view in views])
    order = np.argsort(-(rendered @ _descriptor(image, width, height)), kind="stable")
    return [camera.with_pose(candidates[k].world_to_camera) for k in order[:count]]


def _descriptor(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Small blurred image with mean 0 and norm 1 of each channel, as a vector."""
    small = smoothed(resized(image, width, height), DESCRIPTOR_BLUR)
    small = small - small.mean(axis=(0, 1))
    return (small / (np.linalg.norm(small, axis=(0, 1)) + 1e-6)).ravel()
