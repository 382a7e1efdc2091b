"""Reader of images and poses in ROS 2 logs (MCAP files, rosbag2 folders)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras.foreign import PIXEL_OFFSET
from fidsplat.images.files import decode_rgb
from fidsplat.logs.bags import log_messages
from fidsplat.logs.writers import typestore
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError, os_errors
from fidsplat.util.files import path_of
from fidsplat.vision.detect import Detection

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
MAX_DEPTH = 16
"""maximum number of frames between a frame and the world"""
SCENE = "scene"
"""frame of a scene's own axes in an upright world"""
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_ENCODINGS = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
}
"""number of channels, and indices of red, green and blue"""


@dataclass(frozen=True)
class LogImage:
    """A colour image of a log."""

    name: str
    """topic and time"""
    image: np.ndarray
    """(h, w, 3) uint8 RGB"""
    frame: str
    """frame of its camera"""
    stamp: int
    """nanoseconds"""


def messages(path: str | os.PathLike[str], *topics: str) -> Iterator[tuple[str, Any]]:
    """Yield topic and content of each message of a log in order; of all topics if none is given."""
    file, store = path_of(path), typestore()
    with _as_input_error(file):
        for name, kind, _, data in log_messages(file):
            if not topics or name in topics:
                yield name, store.deserialize_cdr(data, kind)


def log_images(path: str | os.PathLike[str], topic: str | None = None) -> Iterator[LogImage]:
    """Yield the colour images of a log in order: rgb8, bgr8, rgba8, bgra8, mono8 and compressed. topic: topic
    to read; None for all. Raises InputError if there are none."""
    file, store, has_images = path_of(path), typestore(), False
    with _as_input_error(file):
        for name, kind, time, data in log_messages(file):
            if kind not in (_IMAGE, _COMPRESSED) or (topic is not None and name != topic):
                continue
            message = store.deserialize_cdr(data, kind)
            image = _decode_image(message)
            if image is not None:
                has_images = True
                yield LogImage(
                    f"{name} {time / 1e9:.3f} s", image, message.header.frame_id, _stamp(message.header)
                )
    if not has_images:
        on_topic = f" on {topic}" if topic else ""
        raise InputError(f"{file} must have colour images{on_topic}, got none; give another file or topic")


def log_poses(path: str | os.PathLike[str]) -> dict[tuple[str, int], np.ndarray]:
    """Poses (4, 4) in the scene by frame and nanoseconds, from `/tf`: relative to the frame `scene`, or else
    to the frame without a parent. Each frame in between must have a pose of the same time."""
    file, store, transforms = path_of(path), typestore(), {}
    with _as_input_error(file):
        for _, kind, _, data in log_messages(file):
            for stamped in store.deserialize_cdr(data, kind).transforms if kind == _TRANSFORMS else ():
                transforms[stamped.child_frame_id, _stamp(stamped.header)] = stamped
    children = {frame for frame, _ in transforms}
    poses = {}
    for frame, stamp in transforms:
        pose, parent = np.eye(4), frame
        for _ in range(MAX_DEPTH):
            stamped = transforms.get((parent, stamp))
            if stamped is None:
                break
            pose, parent = _pose(stamped.transform) @ pose, stamped.header.frame_id
        if parent not in children:
            poses[frame, stamp] = pose
    scenes = {stamp: np.linalg.inv(pose) for (frame, stamp), pose in poses.items() if frame == SCENE}
    return {
        (frame, stamp): scenes[stamp] @ pose if stamp in scenes else pose
        for (frame, stamp), pose in poses.items()
    }


@contextmanager
def _as_input_error(file: Path) -> Iterator[None]:
    try:
        with os_errors(f"cannot read {file}"):
            yield
    except InputError:
        raise
    except Exception as error:  # errors of five packages that read, decompress and decode
        raise InputError(f"cannot read {file} as a log: {error}; record or copy it again") from None


def detections_of(message: Any) -> list[Detection]:
    """Tags of an AprilTagDetectionArray, as `RobotLog.detections` writes them."""
    detections = []
    for detection in message.detections:
        corners = np.array([(corner.x, corner.y) for corner in detection.corners]) + PIXEL_OFFSET
        detections.append(Detection("apriltag", detection.family, detection.id, None, corners))
    return detections


def points_of(message: Any) -> np.ndarray:
    """Points (n, 3) of a PointCloud2 with x, y and z of one type, as `RobotLog.points` writes them."""
    offsets = {field.name: field.offset for field in message.fields}
    kind = np.dtype(
        {
            "names": list("xyz"),
            "formats": ["<f4"] * 3,
            "offsets": [offsets[axis] for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    points = np.frombuffer(np.asarray(message.data, np.uint8).tobytes(), kind)
    return np.stack([points[axis] for axis in "xyz"], 1)


def _stamp(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def _pose(transform: Any) -> np.ndarray:
    at, rotation = transform.translation, transform.rotation
    return rigid_matrix((at.x, at.y, at.z), (rotation.w, rotation.x, rotation.y, rotation.z))


def _decode_image(message: Any) -> np.ndarray | None:
    if message.__msgtype__ == _COMPRESSED:
        return decode_rgb(bytes(message.data))
    if message.encoding not in _ENCODINGS:
        return None
    channels, order = _ENCODINGS[message.encoding]
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return np.ascontiguousarray(pixels[..., order])
