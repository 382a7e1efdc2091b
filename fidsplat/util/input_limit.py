"""Limit on the memory that an input file may expand to, which refuses decompression bombs unread."""

from __future__ import annotations

import os
from pathlib import Path

from fidsplat.util.errors import InputError, bytes_words

VARIABLE = "FIDSPLAT_INPUT_LIMIT"
"""environment variable with a number of bytes, which takes the place of the limit"""
FLOOR = 2**29
"""bytes that any file may expand to: an honest image of one colour is a thousand times larger than its PNG"""
RATIO = 64
"""times its size on disk that a larger file may expand to; scenes in SOG and SPZ expand some 20 times"""


def input_limit(size: int) -> int:
    """Bytes that a file of so many bytes may expand to: `FIDSPLAT_INPUT_LIMIT`, or 512 MiB or 64 times its
    size, whichever is larger, but at most half of the machine's memory."""
    text = os.environ.get(VARIABLE)
    if text is None:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**33
        return min(max(FLOOR, RATIO * size), memory // 2)
    if not text.isdecimal() or int(text) == 0:
        raise InputError(f"{VARIABLE} must be a number of bytes above 0, got {text!r}; e.g. {2**32}")
    return int(text)


def check_expansion(path: Path | str, need: float, what: str, size: int | None = None) -> None:
    """Check what a file declares against `input_limit`.

    Args:
        path: the file, or for a part of one that has a size, what to call it.
        need: bytes of memory that reading takes.
        what: what the file declares, for the error: "100,000,000 splats".
        size: bytes of the file or of its compressed part; default what it takes on the disk, without
            the holes of a sparse file.

    Raises InputError above the limit.
    """
    if size is None:
        status = Path(path).stat()
        size = min(status.st_size, 512 * status.st_blocks)
    if need > (limit := input_limit(size)):
        raise InputError(
            f"{path} must expand to at most {bytes_words(limit)}, as it has {bytes_words(size)}, got {what}, "
            f"{bytes_words(need)}; if you trust the file, set {VARIABLE}={int(need) + 1}"
        )
