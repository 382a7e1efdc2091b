"""The folder of a store that is to be: its name, and where it is filled before it has it."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fidsplat.store.layout import HEADER, SUFFIX
from fidsplat.util.arguments import flag
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of, writable_folder


def store_folder(out: str | os.PathLike[str]) -> Path:
    """The folder of a store that is to be. Raises InputError for a name that is none's."""
    folder = path_of(out)
    if folder.suffix.lower() != SUFFIX or not folder.stem:
        raise InputError(
            f"{os.fspath(out)!r} is no name for a store; it ends with {SUFFIX}, e.g. city{SUFFIX}"
        )
    return folder


def refuse_existing(folder: Path, overwrite: bool) -> None:
    """Raises InputError for a store that is there and is not to be replaced, or what is no store."""
    if not flag("overwrite", overwrite) and folder.exists():
        raise InputError(f"{folder} is there already; give another name, or --overwrite")
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is not a folder, so it is no store; give another name")
    if folder.exists() and any(folder.iterdir()) and not (folder / HEADER).exists():
        raise InputError(f"{folder} holds something else than a store; give another name, or remove it")


@contextmanager
def filled(folder: Path) -> Iterator[Path]:
    """A folder beside, for one process at a time, in which lies what one that was stopped left. It gets the
    name `folder` when all went well; what has that name is removed only then.

    Raises InputError: another process fills it; it cannot be written.
    """
    part = folder.with_name(f".{folder.name}.part")
    writable_folder(part)
    try:
        held = os.open(part, os.O_RDONLY)
        try:
            if not _locked(held, part):
                raise InputError(f"another process is building {folder}; wait for it, or give another name")
            yield part
            _put_in_place(part, folder)
        finally:
            os.close(held)
    except OSError as error:
        raise InputError(
            f"cannot write {folder}: {error.strerror or error}; make room, then give the same command again"
        ) from error


def emptied(folder: Path) -> None:
    """Removes what a folder of `filled` holds."""
    for file in folder.iterdir():
        file.unlink()


def _locked(held: int, part: Path) -> bool:
    """Whether the folder is this process's until it is closed, and has not been given its name meanwhile."""
    try:
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(held), part.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _put_in_place(part: Path, folder: Path) -> None:
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(old, ignore_errors=True)  # of a process that was stopped while it removed it
    if folder.exists():
        os.replace(folder, old)
    os.replace(part, folder)
    shutil.rmtree(old, ignore_errors=True)
