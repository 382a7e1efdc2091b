"""Temporary folders for compiled kernels if the caches of PoCL, pyopencl or Warp cannot be used."""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
import warnings
import weakref
from functools import cache
from pathlib import Path

from fidsplat.util.errors import InputError
from fidsplat.util.files import user_cache, writable_folder

MIN_FREE = 2**25
"""minimum free space in bytes: several times the size of a frame's kernels"""


def pocl_folder() -> Path:
    """PoCL's folder of compiled kernels, found by PoCL's own rules."""
    if given := os.environ.get("POCL_CACHE_DIR"):
        return Path(given)
    home = os.environ.get("HOME")
    cache = os.environ.get("XDG_CACHE_HOME") or (f"{home}/.cache" if home else "/tmp")
    return Path(cache) / "pocl" / "kcache"


@cache
def ensure_caches() -> None:
    """Set a temporary folder, with a warning, for each cache that is not writable, is nearly full, belongs to
    another user, or can be written by every user. Called before the first use of a driver."""
    if "HOME" not in os.environ and "XDG_CACHE_HOME" not in os.environ:  # PoCL would use a folder in /tmp
        os.environ.setdefault("POCL_CACHE_DIR", str(user_cache() / "pocl" / "kcache"))
    where = {"POCL_CACHE_DIR": pocl_folder(), "XDG_CACHE_HOME": user_cache()}
    lacking = {name: why for name, folder in where.items() if (why := _why_unusable(folder))}
    if "XDG_CACHE_HOME" not in os.environ and os.path.expanduser("~") == "~":
        lacking["XDG_CACHE_HOME"] = "this user has no home folder"
    if not lacking:
        return
    place = Path(tempfile.mkdtemp(prefix="fidsplat-cache-"))
    weakref.finalize(ensure_caches, _remove, place, os.getpid())
    os.environ.update({name: str(place / name.lower()) for name in lacking})
    warnings.warn(
        f"kernels are compiled again in this run: {'; '.join(lacking.values())}; "
        f"set {' and '.join(lacking)} to a folder of your own with free space",
        stacklevel=2,
    )


def _why_unusable(folder: Path) -> str:
    """Why a folder cannot be used for compiled kernels; empty if it can."""
    try:
        free = shutil.disk_usage(writable_folder(folder)).free
        state = folder.stat()
    except (OSError, InputError) as error:
        return str(error).partition(";")[0]
    if free < MIN_FREE:
        return f"{folder} has only {free // 2**20} MB of free space"
    if hasattr(os, "geteuid") and state.st_uid != os.geteuid():
        return f"{folder} belongs to another user"
    return f"{folder} can be written by every user" if state.st_mode & stat.S_IWOTH else ""


def _remove(place: Path, process: int) -> None:
    if os.getpid() == process:  # not at the end of a fork
        shutil.rmtree(place, ignore_errors=True)
