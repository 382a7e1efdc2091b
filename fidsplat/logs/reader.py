"""Pictures of logs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.errors import InputError
from fidsplat.files import path_of
from fidsplat.logs.files import typestore
from fidsplat.vision.images import decoded

try:
    from mcap.reader import make_reader
    from rosbags.rosbag2 import Reader as BagReader
except ImportError as error:
    raise InputError(f"logs need more packages ({error}); pip install 'fidsplat[logs]'") from None

_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_COLOURS = {"rgb8": (3, [0, 1, 2]), "bgr8": (3, [2, 1, 0]), "rgba8": (4, [0, 1, 2]), "bgra8": (4, [2, 1, 0]),
            "mono8": (1, [0, 0, 0])}  # fmt: skip
"""channels, and which of them are red, green and blue"""


def log_pictures(path: str | os.PathLike[str], topic: str | None = None) -> Iterator[tuple[str, np.ndarray]]:
    """Names (topic and time) and pictures (h, w, 3) uint8 RGB of a log: rgb8, bgr8, rgba8, bgra8, mono8 and
    compressed ones, in the order of the log.

    topic: that one alone; default every topic of such pictures.

    Raises:
        InputError: no log, a damaged one, or one without such pictures.
    """
    file, store, found = path_of(path), typestore(), False
    try:
        for name, kind, time, data in _messages(file):
            if kind not in (_IMAGE, _COMPRESSED) or (topic is not None and name != topic):
                continue
            picture = _picture(store.deserialize_cdr(data, kind))
            if picture is not None:
                found = True
                yield f"{name} {time / 1e9:.3f} s", picture
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error
    except InputError:
        raise
    except (
        Exception
    ) as error:  # of what reads, decompresses and decodes, five packages with errors of their own
        raise InputError(f"{file} is no log that can be read: {error}") from None
    if not found:
        wanted = f" on {topic}" if topic else ""
        raise InputError(f"{file} has no colour pictures{wanted}")


def _messages(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, time in nanoseconds, CDR."""
    if file.is_dir():
        with BagReader(file) as bag:
            for connection, time, data in bag.messages():
                yield connection.topic, connection.msgtype, time, data
        return
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is not None and channel.message_encoding == "cdr":
                yield channel.topic, schema.name, message.log_time, message.data


def _picture(message: Any) -> np.ndarray | None:
    if message.__msgtype__ == _COMPRESSED:
        return decoded(bytes(message.data))
    if message.encoding not in _COLOURS:
        return None
    channels, order = _COLOURS[message.encoding]
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return np.ascontiguousarray(pixels[..., order])
