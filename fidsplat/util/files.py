"""Checked paths, atomic writes, and reads of regular files."""

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
from fidsplat.util.errors import DeviceError, InputError, os_errors
from fidsplat.util.limits import check_expansion

MAX_NAME, MAX_PATH = 255, 4095
"""bytes of a file name and of a path on Linux"""


def path_of(path: str | os.PathLike[str]) -> Path:
    """A path as pathlib.Path. Raises InputError for a value that cannot be the path of a file."""
    try:
        name = os.fspath(path)
    except TypeError:
        name = None
    try:
        if not isinstance(name, str) or b"\0" in os.fsencode(name):
            raise ValueError
    except ValueError:  # also for half of a surrogate pair
        raise InputError(f"a path must be text without NUL, or a pathlib.Path, got {path!r}") from None
    if len(os.fsencode(name)) > MAX_PATH or any(
        len(os.fsencode(part)) > MAX_NAME for part in Path(name).parts
    ):
        raise InputError(
            f"a file name must have at most {MAX_NAME} bytes, and a path {MAX_PATH} bytes, got {name!r}"
        )
    try:
        os.stat(name)
    except PermissionError as error:  # `Path.exists` raises it too
        raise InputError(
            f"cannot access {name}: {error.strerror}; change the permissions of its folder, or give another "
            "path"
        ) from None
    except OSError:
        pass
    return Path(name)


def ordinary_file(path: str | os.PathLike[str]) -> Path:
    """Check that a path is a regular file or does not exist; raise InputError for a folder or device."""
    target = path_of(path)
    if target.exists() and not target.is_file():
        raise InputError(
            f"cannot write {target}: it must be a regular file, got {kind_of(target)}; give the "
            "name of a file"
        )
    return target


def writable_file(path: str | os.PathLike[str]) -> Path:
    """The path of a file that can be written. Raises InputError if it cannot."""
    file = path_of(path)
    if file.is_dir():
        raise InputError(f"the output must be a file, got the folder {file}; name a file in it")
    writable_folder(file.parent)
    return ordinary_file(file)


def new_file(path: str | os.PathLike[str], overwrite: bool) -> Path:
    """The path of a writable file that does not exist yet or may be replaced. Raises InputError otherwise."""
    file = writable_file(path)
    refuse_existing(file, overwrite)
    return file


def refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise InputError for an existing file or folder, unless it may be replaced."""
    if path.exists() and not overwrite:
        raise InputError(f"{path} already exists; give another name, or --overwrite")


_KINDS = {
    stat.S_IFREG: "a file",
    stat.S_IFDIR: "a folder",
    stat.S_IFIFO: "a pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}


def existing(path: str | os.PathLike[str]) -> Path:
    """The path of a file or folder that exists. Raises InputError."""
    file = path_of(path)
    with os_errors(f"cannot read {file}"):
        file.stat()
    return file


def regular_file(path: str | os.PathLike[str]) -> Path:
    """Check that a path is a regular file, for libraries that open files themselves. Raises InputError for
    others: reading a pipe or a device may block."""
    file = existing(path)
    if not file.is_file():
        raise InputError(f"{file} must be a regular file, got {kind_of(file)}; give the name of a file")
    return file


def kind_of(path: Path) -> str:
    """Type of a path for messages: "a file", "a folder", "a pipe", "nothing" and so on."""
    try:
        return _KINDS.get(stat.S_IFMT(path.stat().st_mode), "something else")
    except OSError:
        return "nothing"


def open_input(path: str | os.PathLike[str]) -> BinaryIO:
    """Open an input file for binary reading. Raises InputError if it is not a regular file."""
    file = regular_file(path)
    with os_errors(f"cannot read {file}"):
        # O_NONBLOCK: if a pipe has replaced the file since the check, opening it does not block
        return os.fdopen(os.open(file, os.O_RDONLY | os.O_CLOEXEC | getattr(os, "O_NONBLOCK", 0)), "rb")


def read_input(path: str | os.PathLike[str], max_bytes: int | None = None, first: int | None = None) -> bytes:
    """Read an input file, or only its `first` bytes. Raises InputError if it is not regular, unreadable,
    larger than `max_bytes` or beyond `input_limit`."""
    with open_input(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        if max_bytes is not None and size > max_bytes:
            raise InputError(f"{path} must have at most {max_bytes:,} bytes, got {size:,}; give another file")
        if first is None:
            check_expansion(path_of(path), size, "its length")
        with os_errors(f"cannot read {path}"):
            return stream.read(-1 if first is None else min(first, size))


def read_text(path: str | os.PathLike[str], errors: str = "strict") -> str:
    """Read an input file as UTF-8, with line ends converted to \\n. Raises InputError if it cannot be read,
    and ValueError for bytes that are not UTF-8. errors: as for `bytes.decode`."""
    return read_input(path).decode("utf-8", errors).replace("\r\n", "\n").replace("\r", "\n")


@contextmanager
def utf8_path(path: Path) -> Iterator[Path]:
    """Context with a path whose name is UTF-8: the path itself, or a symbolic link to it, for libraries that
    crash on other names."""
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
    """Escape the bytes of a file name that are not UTF-8, for pages and charts."""
    return text.encode("utf-8", "backslashreplace").decode()


def from_json(text: str | bytes, finite: bool = False) -> Any:
    """Parse JSON. Raises ValueError for invalid JSON, and with `finite` for infinities and NaN."""
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
    """Open a temporary file next to ``path`` for binary writing, and rename it to ``path`` after success, so
    that ``path`` is never incomplete. durable: flush it to the disk, in case of a power failure."""
    with atomic_path(path) as part, part.open("wb") as stream:
        yield stream
        if durable:
            stream.flush()
            os.fsync(stream.fileno())
    if durable:
        folder = os.open(path_of(path).parent, os.O_RDONLY)
        try:
            os.fsync(folder)  # the directory entry
        finally:
            os.close(folder)


def write_file(path: str | os.PathLike[str], content: bytes | str) -> Path:
    """Write a file atomically, text as UTF-8. Raises InputError if it cannot be written."""
    with atomic_write(path) as stream:
        stream.write(content.encode() if isinstance(content, str) else content)
    return Path(path)


def write_json(path: str | os.PathLike[str], value: Any, indent: int | None = None) -> Path:
    """Write plain data as a JSON file, atomically. Raises ValueError for infinities and NaN."""
    return write_file(path, json.dumps(value, indent=indent, allow_nan=False))


@contextmanager
def atomic_path(path: str | os.PathLike[str], suffix: str = "") -> Iterator[Path]:
    """Create an empty temporary file, and rename it to ``path`` after success, for libraries that open files.
    suffix: suffix of the temporary name."""
    interrupts.check()
    target = ordinary_file(path)
    with os_errors(f"cannot write {target}"):
        descriptor, name = tempfile.mkstemp(
            prefix=f".{target.name}.", suffix=f".part{suffix}", dir=target.parent
        )
        try:
            os.close(descriptor)
            with utf8_path(Path(name)) as part:
                yield part
            os.chmod(name, 0o666 & ~_umask())
            os.replace(name, target)
        except BaseException:
            os.unlink(name)
            raise


def writable_folder(path: str | os.PathLike[str]) -> Path:
    """Create a folder with its parents, and check that it is writable."""
    folder = path_of(path)
    with os_errors(f"cannot write into the folder {folder}", "choose another output folder"):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    return folder


def user_cache() -> Path:
    """The user's cache folder, or the folder for temporary files if the user has no home."""
    home = os.path.expanduser("~")
    return Path(
        os.environ.get("XDG_CACHE_HOME") or (tempfile.gettempdir() if home == "~" else f"{home}/.cache")
    )


def _umask() -> int:
    # the only portable way to read the mask is to set it
    mask = os.umask(0)
    os.umask(mask)
    return mask


def kernels_folder() -> Path:
    """The folder of the kernels: `kernels/` next to the package in a checkout, `fidsplat/_kernels` in a
    wheel."""
    here = Path(__file__).resolve().parents[1]
    folders = (here / "_kernels", here.parent / "kernels")
    for folder in folders:
        if (folder / "opencl").is_dir():
            return folder
    raise DeviceError(
        f"the kernels must be in {folders[0]} or {folders[1]}, got neither folder; reinstall fidsplat"
    )
