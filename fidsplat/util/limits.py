"""Limits: memory that input files may expand to, and limits of the process (`ulimit`) below which libraries
and drivers crash. This module imports only the standard library, as it runs before slow imports."""

from __future__ import annotations

import os
import sys
from functools import cache
from pathlib import Path

from fidsplat.util.errors import DeviceError, InputError, bytes_words

try:
    import resource
except ImportError:  # Windows has no such limits
    resource = None

VARIABLE = "FIDSPLAT_INPUT_LIMIT"
"""environment variable with a number of bytes that replaces the limit of a file"""
FLOOR = 2**29
"""bytes that any file may expand to, as an image of one colour is a thousand times larger than its PNG"""
RATIO = 64
"""maximum ratio of a larger file's expanded size to its size; SOG and SPZ files expand about 20 times"""


def input_limit(size: int) -> int:
    """Bytes that a file of `size` bytes may expand to: `FIDSPLAT_INPUT_LIMIT`, or else 64 times its size, at
    least 512 MiB and at most half of the machine's memory."""
    text = os.environ.get(VARIABLE)
    if text is None:
        return min(max(FLOOR, RATIO * size), _half_of_memory())
    if not text.isdecimal() or int(text) == 0:
        raise InputError(
            f"{VARIABLE} must be a number of bytes above 0, got {text!r}; write for example {2**32}"
        )
    return int(text)


def _half_of_memory() -> int:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else 2**33
    return memory // 2


def check_total(what: str, need: int, remedy: str) -> None:
    """Raise InputError if a scene needs more bytes of memory than `FIDSPLAT_INPUT_LIMIT`, by default half of
    the machine's memory."""
    limit = input_limit(0) if VARIABLE in os.environ else _half_of_memory()
    if need > limit:
        raise InputError(
            f"{what} must take at most {bytes_words(limit)}, got at least {bytes_words(need)}; {remedy}, or "
            f"set {VARIABLE} to a larger number of bytes"
        )


def check_expansion(path: Path | str, need: float, what: str, size: int | None = None) -> None:
    """Raise InputError if a file would expand beyond `input_limit`.

    Args:
        path: the file; with `size`, any description of the compressed data.
        need: bytes of memory after expansion.
        what: declared content, for the message: "100,000,000 splats".
        size: bytes of the compressed data; None: bytes of the file on the disk, without the holes of a sparse
            file.
    """
    if size is None:
        status = Path(path).stat()
        size = min(status.st_size, 512 * status.st_blocks)
    if need > (limit := input_limit(size)):
        raise InputError(
            f"{path} must expand to at most {bytes_words(limit)} for its size of {bytes_words(size)}, "
            f"got {what} ({bytes_words(need)} expanded); if you trust the file, set "
            f"{VARIABLE}={int(need) + 1}"
        )


def check_holes(path: Path | str) -> None:
    """Raise InputError if a file to be memory-mapped is sparse and much larger than its data on the disk."""
    status = Path(path).stat()
    stored = 512 * status.st_blocks
    if status.st_size > (limit := max(input_limit(0), RATIO * stored)):
        raise InputError(
            f"{path} must have at most {bytes_words(limit)}, as it has {bytes_words(stored)} on the disk, "
            f"got {bytes_words(status.st_size)}; if you trust the file, set {VARIABLE}={status.st_size}"
        )


_IMPORTS, _DRIVER, _PER_CORE, _SPARE = 640 * 2**20, 640 * 2**20, 2**24, 2**28
"""bytes of address space for: NumPy, OpenCV and so on; a driver with its compiler; the threads of each core;
further imports of a command and a small scene"""
_FILE = 2**24
"""largest file of a driver's compiler in bytes"""
_OPEN_FILES = 32
"""file descriptors of a command and a driver's compiler and linker"""


def check_imports() -> None:
    """Raise InputError if the memory limit is too low for imports, in which OpenBLAS would crash."""
    needed = _IMPORTS + _cores() * _PER_CORE
    if (space := _limit("RLIMIT_AS")) < needed:
        raise InputError(
            f"the limit on memory must be at least {bytes_words(needed)}, got {bytes_words(space)}; "
            f"raise it with `ulimit -v {_sufficient() // 2**10}`"
        )


@cache
def check_driver_limits(family: str) -> None:
    """Raise DeviceError if a limit is so low that the driver of a device family would abort the process.
    Checked only once, as a loaded driver already uses its memory."""
    if (largest := _limit("RLIMIT_FSIZE")) < _FILE:
        raise DeviceError(
            f"the limit on file size must be at least {bytes_words(_FILE)} for compiled kernels, got "
            f"{bytes_words(largest)}; raise it with `ulimit -f`, or use the device reference"
        )
    if (files := _limit("RLIMIT_NOFILE")) < _OPEN_FILES:
        raise DeviceError(
            f"the limit on open files must be at least {_OPEN_FILES} for compiled kernels, got {files}; "
            f"raise it with `ulimit -n {_OPEN_FILES}`, or use the device reference"
        )
    if (space := _limit("RLIMIT_AS")) == float("inf"):
        return
    used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    needed = _DRIVER + _cores() * _PER_CORE
    if space - used < needed:
        raise DeviceError(
            f"the limit on memory must leave at least {bytes_words(needed)} for the driver of {family}, got "
            f"{bytes_words(max(0, space - used))}; raise it with "
            f"`ulimit -v {max(_sufficient(), used + needed + _SPARE) // 2**10}`, or use the device reference"
        )


def _sufficient() -> int:
    """Bytes of address space that suffice for a small scene."""
    return _IMPORTS + _DRIVER + 2 * _cores() * _PER_CORE + _SPARE


def _limit(name: str) -> float:
    """A limit in bytes, or infinity. Only Linux limits memory."""
    if resource is None or (name == "RLIMIT_AS" and sys.platform != "linux"):
        return float("inf")
    limit = resource.getrlimit(getattr(resource, name))[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def _cores() -> int:
    return os.cpu_count() or 1
