"""Writers of MCAP files and rosbag2 folders, which delete incomplete logs."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from fidsplat.logs.bags import bag_metadata
from fidsplat.util.arguments import flag, text
from fidsplat.util.errors import InputError, os_errors, required_package
from fidsplat.util.files import atomic_write, path_of, printable, refuse_existing, writable_folder

with required_package("packages for logs", "logs"):
    from mcap.reader import make_reader
    from mcap.writer import Writer as McapWriter
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as BagWriter
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_APRILTAG = {
    "Point": "float64 x\nfloat64 y",
    "AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography"
    ),
    "AprilTagDetectionArray": "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections",
}
"""message definitions of https://github.com/christianrauch/apriltag_msgs"""


def typestore() -> Any:
    """Message types of ROS 2 Jazzy and apriltag_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, definition in _APRILTAG.items():
        store.register(get_types_from_msg(definition, f"apriltag_msgs/msg/{name}"))
    return store


DEPTHS = {"/tf": 100, "/clock": 1}
"""history by topic: number of messages that wait for a slow subscriber; the oldest are dropped"""
DEPTH = 10


class LogFile(Protocol):
    """Writer of messages; closing it creates the log."""

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        """Write a message of a type (kind) as CDR, at a time in nanoseconds."""
        ...

    def close(self, keep: bool) -> None:
        """Complete the log, or discard it."""
        ...


_METADATA = "fidsplat.source"
"""key of a log's metadata"""


def log_file(path: str | os.PathLike[str], store: Any, overwrite: bool, source: str) -> LogFile:
    """A writer of an MCAP file for NAME.mcap, else of a rosbag2 folder. source: see `RobotLog`."""
    target = _target(path, overwrite)
    with os_errors(f"cannot write {target}"):
        return (_McapFile if target.suffix == ".mcap" else _Bag)(target, store, source)


def check_log(path: str | os.PathLike[str], overwrite: bool, source: str) -> bool:
    """Whether a complete log of the same source exists. Raises InputError if the log cannot be written."""
    flag("overwrite", overwrite)
    if text("source", source) and not overwrite and _source_of(path_of(path)) == source:
        return True
    writable_folder(_target(path, overwrite).parent)
    return False


def _source_of(path: Path) -> str | None:
    """The source in the metadata of a log; None for anything else."""
    try:
        if path.is_dir():
            return bag_metadata(path)["custom_data"][_METADATA]
        if path.is_file():
            with path.open("rb") as stream:
                metadata = make_reader(stream).iter_metadata()
                return next((item.metadata["source"] for item in metadata if item.name == _METADATA), None)
    except Exception:  # the errors of two packages: not a readable log
        pass
    return None


def _target(path: str | os.PathLike[str], overwrite: bool) -> Path:
    target = path_of(path)
    refuse_existing(target, overwrite)
    if target.exists() and target.is_dir() != (target.suffix != ".mcap"):
        kind = "folder" if target.is_dir() else "file"
        raise InputError(
            f"{target} must be a file for .mcap and a folder for rosbag2, got an existing {kind}; give "
            "another name"
        )
    if target.is_dir() and not (target / "metadata.yaml").exists():
        raise InputError(
            f"{target} must have metadata.yaml to be overwritten as a bag, got none; give another name"
        )
    return target


class _Discarded(Exception):
    """Exception that discards a log."""


class _McapFile:
    def __init__(self, target: Path, store: Any, source: str) -> None:
        self._store, self._source = store, source
        with ExitStack() as stack:
            self._writer = McapWriter(stack.enter_context(atomic_write(target)))
            self._writer.start(profile="ros2", library="fidsplat")
            self._file = stack.pop_all()
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._count = 0

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        if kind not in self._schemas:
            definition, _ = self._store.generate_msgdef(kind, ros_version=2)
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", definition.encode())
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "cdr", self._schemas[kind])
        self._writer.add_message(self._channels[topic], time, data, time, self._count)
        self._count += 1

    def close(self, keep: bool) -> None:
        with suppress(_Discarded), self._file:
            if not keep:
                raise _Discarded
            if self._source:
                self._writer.add_metadata(_METADATA, {"source": self._source})
            self._writer.finish()


class _Bag:
    def __init__(self, target: Path, store: Any, source: str) -> None:
        self._target, self._store = target, store
        self._folder = Path(tempfile.mkdtemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent))
        # rosbags interprets "?", "#" and "%" in a path as parts of a URI
        self._link = tempfile.TemporaryDirectory()
        link = Path(self._link.name, "link")
        link.symlink_to(self._folder.absolute())
        name = re.sub("[?#%]", "_", printable(target.name))
        self._made = self._folder / name
        self._writer = BagWriter(link / name, version=9, storage_plugin=StoragePlugin.SQLITE3)
        if source:
            self._writer.set_custom_data(_METADATA, source)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        with _sqlite_errors():
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
            self._writer.write(self._connections[topic], time, data)

    def close(self, keep: bool) -> None:
        try:
            if keep:
                with _sqlite_errors():
                    self._writer.close()
                if self._target.exists():
                    self._target.rename(self._folder / "before")
                self._made.rename(self._target)
            else:
                with suppress(Exception):  # the first error is reported
                    self._writer.close()
        finally:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._link.cleanup()


@contextmanager
def _sqlite_errors() -> Iterator[None]:
    """Convert errors of the SQLite package of rosbags to OSError."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:
        raise OSError(str(error)) from error
