"""Atomic writes of files, and reads of input files that refuse what is not a regular file."""

import json
import math
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.input_limit import check_expansion

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


_KINDS = {
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def regular_file(path: str | os.PathLike[str]) -> Path:
    """Check that a path is a regular file, for libraries that open files themselves.

    Raises InputError when it is missing, and for a folder, a pipe or a device: to open or to read these may
    wait for ever.
    """
    file = path_of(path)
    try:
        mode = file.stat().st_mode
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error
    if not stat.S_ISREG(mode):
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise InputError(f"{file} must be a regular file, got {kind}; give the name of a file")
    return file


def open_input(path: str | os.PathLike[str]) -> BinaryIO:
    """Open an input file for binary reading. Raises InputError as `regular_file`, and when opening fails."""
    file = regular_file(path)
    try:
        # O_NONBLOCK: a pipe that has taken the file's place since the check is then empty, not waited for
        return os.fdopen(os.open(file, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0)), "rb")
    except OSError as error:
        raise InputError(f"cannot read {file}: {error.strerror or error}") from error


def read_input(path: str | os.PathLike[str], most: int | None = None, first: int | None = None) -> bytes:
    """Read an input file.

    most: bytes that it may have. first: read so many of its first bytes alone.

    Raises InputError as `open_input`, for a longer file or one beyond `input_limit`, and when reading fails.
    """
    with open_input(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if most is not None and size > most:
            raise InputError(f"{path} must have at most {most:,} bytes, got {size:,}; give another file")
        if first is None:
            check_expansion(path_of(path), size, "its length")
        try:
            return stream.read(-1 if first is None else first)
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def read_text(path: str | os.PathLike[str], errors: str = "strict") -> str:
    """Read an input file as UTF-8, each line ended by \\n. Raises InputError as `read_input`, and ValueError
    for bytes that are not UTF-8 unless `errors`, as of `bytes.decode`, allows them."""
    return read_input(path).decode("utf-8", errors).replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """A name of a file for libraries that crash on names other than UTF-8: a symbolic link to such a file."""
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory() as folder:
            link = Path(folder, "link" + path.suffix.encode("ascii", "ignore").decode())
            link.symlink_to(path.absolute())
            yield link
    else:
        yield path


def printable(text: str) -> str:
    """Text in which escapes stand for bytes of file names that are not UTF-8, for pages and charts."""
    return text.encode("utf-8", "backslashreplace").decode()


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
def atomic_write(path: str | os.PathLike[str], durable: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file beside ``path`` for binary writing and move it onto ``path`` when all went well.

    A reader never sees half a file, and a run that is stopped leaves the old one as it was.

    durable: wait until the disk has the file, so that a power cut leaves the new file or the old one too.

    Raises InputError when the folder is missing or cannot be written.
    """
    with atomic_path(path) as part, part.open("wb") as stream:
        yield stream
        if durable:
            stream.flush()
            os.fsync(stream.fileno())
    if durable:
        folder = os.open(path_of(path).parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the name of the file
        finally:
            os.close(folder)


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
        with utf8_path(Path(name)) as part:
            yield part
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
