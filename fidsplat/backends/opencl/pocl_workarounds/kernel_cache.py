"""Removes from PoCL's kernel cache what an interrupted process has left half written.

PoCL 3 loads what it finds there without a look: a bitcode file or a shared object that is cut off, empty or
noise ends the process ("LLVM ERROR", SIGBUS, abort) or gives a program without kernels, on that run and on
every later one. So files that are not whole are removed before PoCL is first asked for a program; it then
compiles them again. PoCL gives a file its name when it is written; what another process is about to finish is
called tempfile_*, and is left alone: without it that process would end ("Final linking of kernel ...
failed").
"""

from __future__ import annotations

import os
import struct
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from fidsplat.backends.caches import pocl_folder

_BITCODE, _ELF = b"BC\xc0\xde", b"\x7fELF\x02\x01"
_ENTER_SUBBLOCK = 1
_UNFINISHED = "tempfile_"


@cache
def check_once() -> None:
    """Looks through PoCL's cache, once in a process."""
    remove_broken(pocl_folder())


def remove_broken(folder: Path) -> int:
    """Removes the bitcode files and shared objects below a folder that are not whole; returns their number.

    What was looked at once is not looked at again: the time of the last look is that of a file beside the
    programs.
    """
    stamp, now = folder / "fidsplat-checked", time.time()
    try:
        last = stamp.stat().st_mtime
    except OSError:
        last = 0.0
    if last > now:  # the clock was put back: what is new looks old
        last = 0.0
    removed = 0
    for place, _, names in os.walk(folder):
        for name in names:
            path = Path(place, name)
            with suppress(OSError):  # it is another's cache too: what is not there any more is no error
                if not name.endswith((".so", ".bc")) or name.startswith(_UNFINISHED):
                    continue
                if path.stat().st_mtime >= last - 1 and not is_whole(path):
                    path.unlink()
                    removed += 1
    with suppress(OSError):  # a folder that cannot be written is looked through every time
        stamp.touch()
        os.utime(stamp, (now, now))
    return removed


def is_whole(path: Path) -> bool:
    """Whether a bitcode file or a shared object reaches as far as its own headers say."""
    with path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        return _is_whole_elf(stream, size) if path.suffix == ".so" else _is_whole_bitcode(stream, size)


def _is_whole_elf(stream: BinaryIO, size: int) -> bool:
    """The table of sections is the last thing that a linker writes."""
    head = stream.read(64)
    if len(head) < 64 or not head.startswith(_ELF):
        return False
    (sections,) = struct.unpack_from("<Q", head, 0x28)
    each, count = struct.unpack_from("<HH", head, 0x3A)
    return sections + each * count <= size


def _is_whole_bitcode(stream: BinaryIO, size: int) -> bool:
    """Walks over the top-level blocks of an LLVM bitstream, each of which says how many words it has."""
    if stream.read(4) != _BITCODE or size % 4:
        return False
    at = 4
    while at < size:
        # an abbreviation id in 2 bits, the block's id and the width of ids in it: one word for all blocks
        # that LLVM has at the top level; then the number of words
        stream.seek(at)
        head = stream.read(8)
        if len(head) < 8 or head[0] & 3 != _ENTER_SUBBLOCK:
            return False
        at += 8 + 4 * struct.unpack_from("<I", head, 4)[0]
    return at == size
