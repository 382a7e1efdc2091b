"""Check of PoCL's kernel cache, from which PoCL loads files without a check.

A damaged bitcode file or shared object ends the process or yields a program without kernels, in every run.
Such files are removed before PoCL first builds a program. Files named tempfile_* are still being written.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import BinaryIO

_BITCODE, _ELF = b"BC\xc0\xde", b"\x7fELF\x02\x01"
_SECTION = struct.Struct("<4xI16xQQ24x")
"""header of a section: its kind, offset and bytes"""
_NO_BITS, _ENTER_SUBBLOCK = 8, 1
_UNFINISHED = "tempfile_"


def is_loaded(name: str) -> bool:
    """Whether PoCL loads or opens cached files of a name."""
    return name.endswith((".so", ".bc", "last_accessed")) and not name.startswith(_UNFINISHED)


def is_complete(path: Path) -> bool:
    """Whether a bitcode file or a shared object has the length that its headers state."""
    if path.suffix not in (".so", ".bc"):
        return True
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        return _is_complete_elf(stream, size) if path.suffix == ".so" else _is_complete_bitcode(stream, size)


def _is_complete_elf(stream: BinaryIO, size: int) -> bool:
    """Whether the file contains the section table and every section; GNU ld writes the table last."""
    head = stream.read(64)
    if len(head) < 64 or not head.startswith(_ELF):
        return False
    (table,) = struct.unpack_from("<Q", head, 0x28)
    entry_bytes, count = struct.unpack_from("<HH", head, 0x3A)
    if entry_bytes != _SECTION.size or table + entry_bytes * count > size:
        return False
    stream.seek(table)
    sections = _SECTION.iter_unpack(stream.read(entry_bytes * count))
    return all(kind == _NO_BITS or offset + length <= size for kind, offset, length in sections)


def _is_complete_bitcode(stream: BinaryIO, size: int) -> bool:
    """Whether the top-level blocks of an LLVM bitstream, whose headers state their lengths, fill the file."""
    if stream.read(4) != _BITCODE or size % 4:
        return False
    at = 4
    while at < size:
        # Header ENTER_SUBBLOCK of the format: abbreviation id (2 bits), block id, and new abbreviation width,
        # 32 bits in all for LLVM's top-level blocks; then the length of the block in words
        stream.seek(at)
        head = stream.read(8)
        if len(head) < 8 or head[0] & 3 != _ENTER_SUBBLOCK:
            return False
        at += 8 + 4 * struct.unpack_from("<I", head, 4)[0]
    return at == size
