"""Files written as a whole or not at all, and read with errors of few kinds."""

import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from fidsplat import interrupts
from fidsplat.errors import InputError

MAX_NAME, MAX_PATH = 255, 4095
"""bytes of a file's name and of a path to it, on Linux"""


def path_of(path: str | os.PathLike[str]) -> Path:
    """The path that is meant. Raises InputError for anything but text or a path that a file can have."""
    try:
        name = os.fspath(path)
    except TypeError:
        name = None
    try:
        if not isinstance(name, str) or b"\0" in os.fsencode(name):
            raise ValueError
    except ValueError:  # or half of a surrogate pair, which no name has
        raise InputError(f"{path!r} names no file; give a path as text or a pathlib.Path") from None
    if len(os.fsencode(name)) > MAX_PATH or any(
        len(os.fsencode(part)) > MAX_NAME for part in Path(name).parts
    ):
        raise InputError(f"{name!r} is too long for the name of a file; a name has at most {MAX_NAME} bytes")
    return Path(name)


def ordinary_file(path: str | os.PathLike[str]) -> Path:
    """The path of a file, there or yet to be made.

    Raises InputError for a folder, a device or a pipe: moving a file onto one would replace it.
    """
    target = path_of(path)
    if target.exists() and not target.is_file():
        raise InputError(f"cannot write {target}: it is not an ordinary file; give the name of a file")
    return target


def from_json(text: str | bytes, finite: bool = False) -> Any:
    """What JSON says. Raises ValueError for all that is none, tables in a thousand tables among it; finite:
    and for numbers that are not."""
    numbers: dict[str, Any] = {"parse_float": _finite, "parse_constant": _finite} if finite else {}
    try:
        return json.loads(text, **numbers)
    except RecursionError:
        raise ValueError("it nests too deeply") from None


def _finite(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(text)
    return value


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path`` for binary writing and move it onto ``path`` when all went well.

    A reader never sees half a file, and a run that is stopped leaves the old one as it was.

    Raises InputError when the folder is missing or cannot be written.
    """
    with atomic_path(path) as part, part.open("wb") as stream:
        yield stream


@contextmanager
def atomic_path(path: str | os.PathLike[str], suffix: str = "") -> Iterator[Path]:
    """As `atomic_write`, for libraries that open files themselves: an empty file of a temporary name.

    suffix: what that name ends with, for those that go by it.
    """
    interrupts.check()
    target = ordinary_file(path)
    try:
        descriptor, name = tempfile.mkstemp(
            prefix=f".{target.name}.", suffix=f".part{suffix}", dir=target.parent
        )
    except OSError as error:
        raise InputError(f"cannot write {target}: {error.strerror or error}") from error
    try:
        os.close(descriptor)
        yield Path(name)
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, target)
    except BaseException as error:
        os.unlink(name)
        if isinstance(error, OSError):
            raise InputError(f"cannot write {target}: {error.strerror or error}") from error
        raise


def writable_folder(path: str | os.PathLike[str]) -> Path:
    """Make the folder ``path`` with its parents and prove that a file can be written in it.

    Asked before long work, so that nobody waits for a picture that cannot be kept.

    Raises InputError when it cannot.
    """
    folder = path_of(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"cannot write into the folder {folder}: {error.strerror or error}; choose another output folder"
        ) from error
    return folder


def user_cache() -> Path:
    """The user's cache folder; the one for temporary files where the user has no home."""
    home = os.path.expanduser("~")
    return Path(
        os.environ.get("XDG_CACHE_HOME") or (tempfile.gettempdir() if home == "~" else f"{home}/.cache")
    )


def _umask() -> int:
    # the only portable way to read the mask is to set it; a temporary file is made with 0600 whatever it is
    mask = os.umask(0)
    os.umask(mask)
    return mask
