"""Pictures of logs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.images.files import decoded
from fidsplat.logs.bags import log_messages
from fidsplat.logs.files import typestore
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_COLOURS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]),
            "mono8": (1, [0, 0, 0])}  # fmt: skip
"""channels, and which of them are red, green and blue"""


@dataclass(frozen=True)
class LogPicture:
    """A picture of a log."""

    name: str
    """topic and time"""
    image: np.ndarray
    """(h, w, 3) uint8 RGB"""
    frame: str
    """of its camera"""
    stamp: int
    """nanoseconds"""


def log_pictures(path: str | os.PathLike[str], topic: str | None = None) -> Iterator[LogPicture]:
    """Pictures of a log: rgb8, bgr8, rgba8, bgra8, mono8 and compressed ones, in the order of the log.

    topic: that one alone; default every topic of such pictures.

    Raises:
        InputError: no log, a damaged one, or one without such pictures.
    """
    file, store, found = path_of(path), typestore(), False
    with _damage_told(file):
        for name, kind, time, data in log_messages(file):
            if kind not in (_IMAGE, _COMPRESSED) or (topic is not None and name != topic):
                continue
            message = store.deserialize_cdr(data, kind)
            picture = _picture(message)
            if picture is not None:
                found = True
                yield LogPicture(
                    f"{name} {time / 1e9:.3f} s", picture, message.header.frame_id, _stamp(message.header)
                )
    if not found:
        wanted = f" on {topic}" if topic else ""
        raise InputError(f"{file} has no colour pictures{wanted}")


def log_poses(path: str | os.PathLike[str]) -> dict[tuple[str, int], np.ndarray]:
    """World from frame (4, 4), by frame and nanoseconds: the poses on `/tf` of frames that hang on one which
    hangs on no other.

    Raises:
        InputError: no log, a damaged one, or a pose that is none.
    """
    file, store, found = path_of(path), typestore(), {}
    with _damage_told(file):
        for _, kind, _, data in log_messages(file):
            for one in store.deserialize_cdr(data, kind).transforms if kind == _TRANSFORMS else ():
                found[one.child_frame_id, _stamp(one.header)] = one
    hanging = {frame for frame, _ in found}
    return {key: _pose(one.transform) for key, one in found.items() if one.header.frame_id not in hanging}


@contextmanager
def _damage_told(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error
    except InputError:
        raise
    except (
        Exception
    ) as error:  # of what reads, decompresses and decodes, five packages with errors of their own
        raise InputError(f"{file} is no log that can be read: {error}") from None


def _stamp(header: Any) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def _pose(transform: Any) -> np.ndarray:
    at, turn = transform.translation, transform.rotation
    return rigid_matrix((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))


def _picture(message: Any) -> np.ndarray | None:
    if message.__msgtype__ == _COMPRESSED:
        return decoded(bytes(message.data))
    if message.encoding not in _COLOURS:
        return None
    channels, order = _COLOURS[message.encoding]
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return np.ascontiguousarray(pixels[..., order])
