"""Pictures of logs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fidsplat.logs.files import typestore
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError
from fidsplat.util.files import open_input, path_of, regular_file, utf8_path
from fidsplat.util.input_limit import check_expansion
from fidsplat.vision.images import decoded

try:
    import lz4.frame
    import zstandard
    from mcap.data_stream import ReadDataStream
    from mcap.reader import make_reader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader
    from rosbags.rosbag2 import Reader as BagReader
except ImportError as error:
    raise InputError(f"logs need more packages ({error}); pip install 'fidsplat[logs]'") from None

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
        for name, kind, time, data in _messages(file):
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
        for _, kind, _, data in _messages(file):
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


def _messages(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
    """Topic, type, time in nanoseconds, CDR."""
    if file.is_dir():
        for part in file.iterdir():
            regular_file(part)
        with utf8_path(file) as name, BagReader(name) as bag:
            for connection, time, data in bag.messages():
                yield connection.topic, connection.msgtype, time, data
        return
    with open_input(file) as stream:
        _check_chunks(file, stream)
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is not None and channel.message_encoding == "cdr":
                yield channel.topic, schema.name, message.log_time, message.data


def _check_chunks(file: Path, stream: BinaryIO) -> None:
    """Check what the chunks of an MCAP file expand to: one by one, or without an index, which says in which
    order to read them, all together. Raises InputError above the limit."""
    summary, need = make_reader(stream).get_summary(), 0
    if summary is not None and summary.chunk_indexes:
        for index in summary.chunk_indexes:
            stream.seek(index.chunk_start_offset + 9)  # behind its opcode and length
            chunk = Chunk.read(ReadDataStream(stream))
            check_expansion(file, _expanded(chunk), "a chunk", len(chunk.data))
    else:
        stream.seek(0)
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                need += _expanded(record)
                check_expansion(file, need, "chunks without an index")
    stream.seek(0)


def _expanded(chunk: Chunk) -> int:
    """Bytes that a chunk expands to, by itself or by its compressed data, whichever says more."""
    said = 0
    if chunk.compression == "zstd":
        said = zstandard.frame_content_size(chunk.data)
    elif chunk.compression == "lz4":
        said = lz4.frame.get_frame_info(chunk.data)["content_size"]
    return max(chunk.uncompressed_size, said)


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
