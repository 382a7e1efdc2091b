"""Reader of rosbag2 folders and MCAP files: metadata and messages, with zstd compression."""

from __future__ import annotations

import os
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path, PurePath
from typing import Any, BinaryIO
from urllib.parse import quote

from fidsplat.util.errors import InputError, required_package
from fidsplat.util.files import open_input, read_input, regular_file
from fidsplat.util.limits import check_expansion, input_limit

with required_package("packages for logs", "logs"):
    import lz4.frame
    import zstandard
    from mcap.data_stream import ReadDataStream
    from mcap.reader import make_reader
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader
    from ruamel.yaml import YAML  # rosbags' own reader neither limits expansion nor quotes names

MAX_METADATA = 2**20
"""largest metadata.yaml in bytes, as a Python parser reads it"""
_STEP = 2**20

Message = tuple[str, str, int, bytes]
"""topic, type, time in nanoseconds, CDR"""


def bag_metadata(folder: Path) -> dict[str, Any]:
    """Metadata of a bag. Raises InputError for a missing or unsuitable metadata.yaml, and errors of the YAML
    package."""
    path = folder / "metadata.yaml"
    text = read_input(path, max_bytes=MAX_METADATA).decode("utf-8")
    if "<<" in text:  # nested merges take exponential time
        raise InputError(f"{path} must not contain YAML merge keys, got '<<'; write the mappings out")
    return YAML(typ="safe", pure=True).load(text)["rosbag2_bagfile_information"]


def log_messages(path: Path) -> Iterator[Message]:
    """CDR messages of an MCAP file or a rosbag2 folder. Raises InputError for missing files and for files
    that expand to more than `input_limit`, and errors of the packages that decode."""
    if not path.is_dir():
        yield from _mcap_messages(path)
        return
    metadata = bag_metadata(path)
    compressed = (metadata.get("compression_mode") or "none").lower()
    form = metadata.get("compression_format") or ""
    if compressed not in ("none", "file", "message") or (compressed != "none" and form != "zstd"):
        raise InputError(
            f"the compression of {path} must be zstd by file or by message, got {compressed} {form}"
        )
    names = [PurePath(name).name for name in metadata["relative_file_paths"]]  # never outside the folder
    for file in (regular_file(path / name) for name in names):
        with tempfile.TemporaryDirectory() as folder:
            if compressed == "file":
                compressed_file, file = file, Path(folder, file.stem)
                with open_input(compressed_file) as source, file.open("wb") as target:
                    _decompress(source, target, compressed_file)
            mcap = metadata.get("storage_identifier") == "mcap" or file.suffix == ".mcap"
            for topic, kind, time, data in (_mcap_messages if mcap else _sqlite_messages)(file):
                if compressed == "message":
                    data = _decompressed(data, path)
                yield topic, kind, time, data


def _decompress(source: BinaryIO, target: BinaryIO, path: Path) -> None:
    """Decompress a zstd file of any number of frames; raise InputError above the limit."""
    size = 0
    with zstandard.ZstdDecompressor().stream_reader(source, read_across_frames=True) as stream:
        while part := stream.read(_STEP):
            size += len(part)
            check_expansion(path, size, "zstd data")
            target.write(part)


def _decompressed(data: bytes, path: Path) -> bytes:
    """Decompress a message; raise InputError above the limit."""
    limit = input_limit(len(data))
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        parts, size = [], 0
        while part := stream.read(_STEP):
            size += len(part)
            if size > limit:
                check_expansion(f"a message of {path}", size, "zstd data", len(data))
            parts.append(part)
    return b"".join(parts)


def _sqlite_messages(path: Path) -> Iterator[Message]:
    name = quote(os.fsencode(path.absolute()))
    connection = sqlite3.connect(f"file://{name}?immutable=1&mode=ro", uri=True)
    try:
        # generated columns of a table may compute large values
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(input_limit(path.stat().st_size), 10**9))
        connection.execute("PRAGMA trusted_schema = OFF")
        # a view instead of a table may compute endlessly
        kinds = connection.execute("SELECT type FROM sqlite_master WHERE name IN ('messages', 'topics')")
        types = sorted(kind for (kind,) in kinds)
        if types != ["table", "table"]:
            raise InputError(
                f"{path} must have the tables messages and topics, got {', '.join(types) or 'none'}; give a "
                "rosbag2 database"
            )
        cursor = connection.execute(
            "SELECT name, type, timestamp, data FROM messages JOIN topics ON messages.topic_id = topics.id "
            "WHERE serialization_format = 'cdr' ORDER BY timestamp"
        )
        for topic, kind, time, data in cursor:
            if [type(value) for value in (topic, kind, time, data)] != [str, str, int, bytes]:
                raise InputError(
                    f"a message of {path} must have a topic, a type, an integer timestamp and data, got "
                    f"timestamp {time!r}"
                )
            yield topic, kind, time, data
    finally:
        connection.close()


def _mcap_messages(path: Path) -> Iterator[Message]:
    with open_input(path) as stream:
        _check_chunks(path, stream)
        for schema, channel, message in make_reader(stream).iter_messages():
            if schema is not None and channel.message_encoding == "cdr":
                yield channel.topic, schema.name, message.log_time, message.data


def _check_chunks(file: Path, stream: BinaryIO) -> None:
    """Raise InputError if a chunk of an MCAP file expands beyond the limit, or all chunks together if the
    file has no index and must be read completely."""
    summary, need = make_reader(stream).get_summary(), 0
    if summary is not None and summary.chunk_indexes:
        for index in summary.chunk_indexes:
            stream.seek(index.chunk_start_offset + 9)  # skips the opcode and the length
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
    """Expanded bytes of a chunk: the larger of its declared size and the size in its compressed data."""
    size = 0
    if chunk.compression == "zstd":
        size = zstandard.frame_content_size(chunk.data)
    elif chunk.compression == "lz4":
        size = lz4.frame.get_frame_info(chunk.data)["content_size"]
        if not size:
            max_size = min(chunk.uncompressed_size, input_limit(len(chunk.data))) + 1
            size = len(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=max_size))
            if size == max_size:
                raise InputError(
                    f"a chunk must expand to the {max_size - 1:,} bytes that it declares, got more"
                )
    return max(chunk.uncompressed_size, size)
