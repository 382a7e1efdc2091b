"""Staging folder: a store (chunks on disk) is written next to its destination and renamed when complete."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fidsplat.store.layout import HEADER, SUFFIX
from fidsplat.util.arguments import flag
from fidsplat.util.errors import InputError, os_errors
from fidsplat.util.files import path_of, refuse_existing, writable_folder


def store_folder(out: str | os.PathLike[str]) -> Path:
    """Path of a new store. Raises InputError for a name without the suffix .fss."""
    folder = path_of(out)
    if folder.suffix.lower() != SUFFIX or not folder.stem:
        raise InputError(
            f"the name of a store must end with {SUFFIX}, got {os.fspath(out)!r}; try city{SUFFIX}"
        )
    return folder


def check_replaceable(folder: Path, overwrite: bool) -> None:
    """Raise InputError if a path exists, unless it is a store or an empty folder and `overwrite` is set."""
    refuse_existing(folder, flag("overwrite", overwrite))
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} exists and is not a store; give another name")
    if folder.exists() and any(folder.iterdir()) and not (folder / HEADER).exists():
        raise InputError(f"{folder} exists and is not a store; give another name, or remove it")


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Lock the staging folder of `folder` and yield it; on success it replaces `folder`.

    It may contain the files of an interrupted build. Raises InputError if another process has locked it.
    """
    part = folder.with_name(f".{folder.name}.part")
    writable_folder(part)
    with os_errors(f"cannot write {folder}", "free some space, then run the same command"):
        descriptor = os.open(part, os.O_RDONLY)
        try:
            if not _locked(descriptor, part):
                raise InputError(f"another process is building {folder}; wait for it, or give another name")
            yield part
            _rename(part, folder)
        finally:
            os.close(descriptor)


def clear(folder: Path) -> None:
    """Remove all files of a staging folder."""
    for file in folder.iterdir():
        file.unlink()


def _locked(descriptor: int, part: Path) -> bool:
    """Lock a folder for this process; False if another process has locked or renamed it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(descriptor), part.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _rename(part: Path, folder: Path) -> None:
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(old, ignore_errors=True)  # left by an interrupted process
    if folder.exists():
        os.replace(folder, old)
    os.replace(part, folder)
    shutil.rmtree(old, ignore_errors=True)
