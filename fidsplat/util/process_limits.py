"""Limits of the process (`ulimit`) under which libraries and drivers crash, checked before those load."""

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

_IMPORTS, _DRIVER, _PER_CORE = 640 * 2**20, 640 * 2**20, 2**24
"""bytes of address space: of NumPy, OpenCV and so on; of a driver with its compiler; of a core's threads"""
_FILE = 2**24
"""bytes of the largest file that a driver's compiler may write"""
_OPEN_FILES = 32
"""descriptors that a command and a driver's compiler and linker need"""


def check_imports() -> None:
    """Raise InputError where memory is limited to less than imports need: OpenBLAS crashes there."""
    needed = _IMPORTS + _cores() * _PER_CORE
    if (space := _limit("RLIMIT_AS")) < needed:
        raise InputError(
            f"the limit on memory must be at least {bytes_words(needed)}, got {bytes_words(space)}; "
            f"raise it with `ulimit -v {needed // 2**10}`"
        )


@cache
def check_driver(family: str) -> None:
    """Raise DeviceError where a limit is too low for the driver of a family, which would abort the process.
    Checked once: afterwards the driver is part of what the process uses.
    """
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
            f"{bytes_words(max(0, space - used))}; raise it with `ulimit -v {(used + needed) // 2**10}`, or "
            "use the device reference"
        )


def _limit(name: str) -> float:
    """A limit in bytes; infinity where there is none. Memory is limited by Linux alone."""
    if resource is None or (name == "RLIMIT_AS" and sys.platform != "linux"):
        return float("inf")
    limit = resource.getrlimit(getattr(resource, name))[0]
    return float("inf") if limit == resource.RLIM_INFINITY else limit


def _cores() -> int:
    return os.cpu_count() or 1
