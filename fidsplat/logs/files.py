"""Where messages go: an MCAP file, or a rosbag2 folder, whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path
from typing import IO, Any, Protocol

from fidsplat.errors import InputError
from fidsplat.files import path_of

try:
    from mcap.writer import Writer as McapWriter
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore
except ImportError as error:
    raise InputError(f"logs need more packages ({error}); pip install 'fidsplat[logs]'") from None

_APRILTAG = {
    "Point": "float64 x\nfloat64 y",
    "AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography"
    ),
    "AprilTagDetectionArray": "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections",
}
"""messages of https://github.com/christianrauch/apriltag_msgs"""


def typestore() -> Any:
    """The messages of ROS 2 Jazzy, and those of apriltag_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _APRILTAG.items():
        store.register(get_types_from_msg(text, f"apriltag_msgs/msg/{name}"))
    return store


class LogFile(Protocol):
    """Takes messages; on disk once it is closed."""

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        """A message, as CDR. kind: its type. time: nanoseconds."""
        ...

    def close(self, keep: bool) -> None:
        """Put it in its place, or throw it away."""
        ...


def log_file(path: str | os.PathLike[str], store: Any, overwrite: bool) -> LogFile:
    """NAME.mcap for a file, any other name for a rosbag2 folder.

    Raises:
        InputError: it is there and is not to be overwritten, or cannot be written.
    """
    target = path_of(path)
    if target.exists() and not overwrite:
        raise InputError(f"{target} is there already; give another name, or overwrite it (--overwrite)")
    if target.exists() and target.is_dir() != (target.suffix != ".mcap"):
        raise InputError(f"{target} is no log; give another name")
    if target.is_dir() and not (target / "metadata.yaml").exists():
        raise InputError(f"{target} is a folder without metadata.yaml, no bag; give another name")
    try:
        return _McapFile(target, store) if target.suffix == ".mcap" else _Bag(target, store)
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error


class _McapFile:
    def __init__(self, target: Path, store: Any) -> None:
        self._target, self._store = target, store
        descriptor, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
        self._part = Path(name)
        self._stream: IO[bytes] = os.fdopen(descriptor, "wb")
        self._writer = McapWriter(self._stream)
        self._writer.start(profile="ros2", library="fidsplat")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._count = 0

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if kind not in self._schemas:
            text, _ = self._store.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", text.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        self._writer.add_message(self._channels[topic], time, data, time, self._count)
        self._count += 1

    def close(self, keep: bool) -> None:
        try:
            if keep:
                self._writer.finish()
            self._stream.close()
            if keep:
                self._part.chmod(0o644)
                os.replace(self._part, self._target)
        finally:
            self._part.unlink(missing_ok=True)


class _Bag:
    def __init__(self, target: Path, store: Any) -> None:
        self._target, self._store = target, store
        self._folder = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent))
        self._writer = BagWriter(self._folder / target.name, version=9, storage_plugin=StoragePlugin.SQLITE3)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._connections[topic], time, data)

    def close(self, keep: bool) -> None:
        try:
            self._writer.close()
            if keep:
                if self._target.exists():
                    shutil.rmtree(self._target)
                (self._folder / self._target.name).rename(self._target)
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)
