"""Ground truth of an image from its scene: marker poses and corners, label masks, points, optical flow."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.util.arguments import instance, invalid, real_array
from fidsplat.util.errors import InputError
from fidsplat.vision.visible import Visible, visible

Box = tuple[float, float, float, float]
"""pixels x0, y0, x1, y1"""


@dataclass(frozen=True, eq=False)
class MarkerTruth:
    """Ground truth of one marker in an image."""

    placed: PlacedMarker
    truth: np.ndarray
    """(4, 4) camera_from_marker"""
    corners: np.ndarray
    """(4, 2) pixels of the code's corners, NaN behind the camera"""
    visible: float
    """visible fraction, 0 to 1, of the marker with one module of its quiet zone; with occlusion if there
    is a label image"""
    box: Box | None
    """bounding box of the visible part; None if nothing is visible"""

    @property
    def distance(self) -> float:
        """Distance in metres from the camera to the centre of the marker."""
        return float(np.linalg.norm(self.truth[:3, 3]))

    @property
    def tilt(self) -> float:
        """Angle in radians between the marker's normal and the line to the camera: 0 is frontal, more than pi
        / 2 is from behind."""
        distance = self.distance
        towards = float(self.truth[:3, 2] @ self.truth[:3, 3])
        return math.acos(max(-1.0, min(1.0, towards / distance))) if distance else 0.0


@dataclass(frozen=True, eq=False)
class GroupTruth:
    """Mask and bounding box of the splats of one label."""

    label: int
    labels: np.ndarray = field(repr=False)
    """(h, w) int32, the labels of the image"""
    box: Box
    """bounding box of the mask"""

    @cached_property
    def mask(self) -> np.ndarray:
        """(h, w) bool: pixels of this label."""
        return self.labels == self.label


@dataclass(frozen=True, eq=False)
class Truth:
    """Result of `truth_of`: camera, markers and groups of splats."""

    camera: Camera
    """camera of the image, at its pose"""
    markers: list[MarkerTruth]
    """one for each marker of the scene, in order"""
    groups: dict[int, GroupTruth]
    """groups in the image by label; empty for a frame without labels"""


def truth_of(frame: Mapping[str, np.ndarray], scene: Scene, camera: Camera | None = None) -> Truth:
    """Ground truth of an image of a scene.

    Args:
        frame: a Frame, whose own capture has the poses of camera and markers; or images by name,
            rendered with the scene's capture. With `label`, occlusion and masks are included.
        scene: the rendered scene; poses are those at the shutter's time.
        camera: replaces the capture's camera, with its pose.

    Raises:
        InputError: no camera, or one of another size than the image.
    """
    if not isinstance(frame, Mapping) or not frame:
        raise invalid("frame", "a Frame, or images by name", frame)
    first = next(iter(frame))
    camera, markers = at_shutter(frame, scene, camera, np.shape(frame[first]))
    label = frame.get("label")
    groups = {} if label is None else groups_of(label)
    return Truth(camera, marker_truths(markers, camera, label, groups), groups)


def at_shutter(
    frame: Any, scene: Scene, camera: Camera | None, shape: Sequence[int]
) -> tuple[Camera, list[PlacedMarker]]:
    """Camera and markers of a scene at the shutter time of the frame's capture, or else of the scene's
    capture.

    shape: shape of the image. Other arguments and errors: as for `truth_of`.
    """
    instance("scene", scene, Scene, remedy="fs.Scene([cloud]) makes one of splats")
    if camera is not None:
        instance("camera", camera, Camera, "a Camera or None")
    capture = getattr(frame, "capture", None) or scene.capture
    time = capture.shutter.time
    if camera is None:
        camera = capture.camera and capture.motion.moved(capture.camera, time)
    if camera is None:
        raise InputError("the scene must have a camera, got none; give camera=")
    if len(shape) < 2:
        raise InputError(f"the image must be an array (h, w) or (h, w, 3), got the shape {tuple(shape)}")
    if (camera.height, camera.width) != tuple(shape[:2]):
        raise InputError(
            f"the image must have the camera's size, {camera.width} x {camera.height} pixels, got "
            f"{shape[1]} x {shape[0]}"
        )
    groups = dict(capture.motion.groups_at(time))
    markers = [replace(m, pose=groups[m.label] @ m.pose) if m.label in groups else m for m in scene.markers]
    return camera, markers


def marker_truths(
    markers: Sequence[PlacedMarker],
    camera: Camera,
    label: np.ndarray | None = None,
    labels: Container[int] | None = None,
) -> list[MarkerTruth]:
    """Ground truth of markers for a camera. label: (h, w) int32, the labels of the image; None: no occlusion.
    labels: those in this image, if they are known."""
    corners = camera.project(np.reshape([placed.corners for placed in markers], (-1, 3))).reshape(-1, 4, 2)
    truths = []
    for placed, image_corners in zip(markers, corners, strict=True):
        occluded = label is not None and labels is not None and placed.label not in labels
        part = Visible(0.0, None) if occluded else visible(placed, camera, label)
        truths.append(MarkerTruth(placed, camera.world_to_camera @ placed.pose, image_corners, *part))
    return truths


def groups_of(label: np.ndarray) -> dict[int, GroupTruth]:
    """Masks and bounding boxes by label of a label image (h, w) int32; -1 is the background."""
    flat, width = label.reshape(-1), label.shape[1]
    # runs of equal labels are fewer than pixels; some continue in the next row
    starts = np.concatenate([[0], np.flatnonzero(flat[1:] != flat[:-1]) + 1])
    values, ends = flat[starts], np.append(starts[1:], flat.size) - 1
    groups = {}
    for value in np.unique(values[values >= 0]).tolist():
        rows, columns = np.divmod(np.stack([starts, ends])[:, values == value], width)
        columns[:, rows[0] < rows[1]] = [[0], [width - 1]]
        box = columns[0].min(), rows.min(), columns[1].max() + 1, rows.max() + 1
        groups[value] = GroupTruth(value, label, tuple(map(float, box)))  # type: ignore[arg-type]
    return groups


def points_of(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """World points (h, w, 3) float64 of the pixels of a depth output (`depth`, `depth_median`,
    `depth_first`); NaN where the depth is 0."""
    instance("camera", camera, Camera)
    depth = real_array("depth", depth)
    if depth.shape != (camera.height, camera.width):
        raise InputError(
            f"the depth must have the camera's shape {(camera.height, camera.width)}, got {depth.shape}"
        )
    far = np.where(depth > 0, depth, np.nan)
    return camera.unproject(camera.pixel_centers.reshape(-1, 2), far.ravel()).reshape(*depth.shape, 3)


def optical_flow(
    depth: np.ndarray,
    before: Camera,
    after: Camera,
    label: np.ndarray | None = None,
    motions: Mapping[int, np.ndarray] | None = None,
) -> np.ndarray:
    """Optical flow (h, w, 2) float32: pixels right and down; NaN without depth, or outside the view of the
    second camera.

    Args:
        depth: (h, w) of the first image; `depth_first` mixes the fewest surfaces at edges.
        before, after: cameras of the two images.
        label: (h, w) int32 of the first image, required with `motions`.
        motions: {label: (4, 4)}: world motion of the splats of a label between the images.

    Raises:
        InputError: different sizes, motions without labels, or motions that are not rigid.
    """
    instance("after", after, Camera)
    if not isinstance(motions, Mapping | None):
        raise invalid("motions", "{label: (4, 4)} or None", motions)
    if label is not None and (not isinstance(label, np.ndarray) or label.shape != np.shape(depth)):
        raise invalid("label", "an image of the size of depth, or None", label)
    points = points_of(depth, before)
    if motions and label is None:
        raise InputError(
            "label must be given for the motions of groups, got None; render with the output 'label'"
        )
    for value, motion in (motions or {}).items():
        motion = pose_matrix(motion, f"the motion of label {value}")
        check_similarity(motion, f"the motion of label {value}", rigid=True)
        if label is not None:
            matrix, mask = np.asarray(motion, np.float64), label == value
            points[mask] = points[mask] @ matrix[:3, :3].T + matrix[:3, 3]
    moved = after.project(points.reshape(-1, 3)).reshape(*depth.shape, 2)
    return (moved - before.pixel_centers).astype(np.float32)
