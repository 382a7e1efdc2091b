"""Checksums of compiled kernels, which drivers cache in files and load without a check.

A damaged file crashes the driver, or changes its results. Before a driver first loads kernels, files that
differ from their checksum are removed, and the driver compiles them again. Checksums of new files are
recorded when the process ends. If the record itself is damaged, all files are removed.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import stat
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write

_RECORD = "fidsplat-checksums.json"
_CHECKSUM = "crc"
"""key under which the record stores its own checksum"""
_watched: set[Path] = set()

Entry = list[int]
"""checksum, size [bytes], time of the last status change [ns], inode; a file is only read if one of the
last three has changed"""


def check_once(folder: Path, is_loaded: Callable[[str], bool], is_complete: Callable[[Path], bool]) -> None:
    """Check a folder once per process, and record the checksums of its new files when the process ends."""
    folder = folder.absolute()
    if folder in _watched:
        return
    _watched.add(folder)
    remove_damaged(folder, is_loaded, is_complete)
    process = os.getpid()
    atexit.register(lambda: os.getpid() == process and record_new(folder, is_loaded))


def remove_damaged(
    folder: Path, is_loaded: Callable[[str], bool], is_complete: Callable[[Path], bool]
) -> int:
    """Remove files that differ from their checksum, and entries that are not regular files; returns their
    number. Files that the driver does not load (`is_loaded`) are not touched. A file without a checksum is
    removed unless `is_complete` returns True."""
    record, valid, removed = _read(folder), {}, 0
    known = record or {}
    for file in _loaded(folder, is_loaded):
        with suppress(OSError):  # another process may remove files too
            key, state, entry = file.path[len(str(folder)) + 1 :], file.stat(follow_symlinks=False), None
            trusted = key in known or (record is not None and is_complete(Path(file)))
            if stat.S_ISREG(state.st_mode) and trusted:
                entry = _current(file.path, state, known.get(key))
            if entry is not None:
                valid[key] = entry
            else:
                _remove(file.path, state)
                removed += 1
    if valid != record:
        _write(folder, valid)
    return removed


def record_new(folder: Path, is_loaded: Callable[[str], bool]) -> None:
    """Record the checksums of files that have none yet."""
    known, new = _read(folder) or {}, {}
    for file in _loaded(folder, is_loaded):
        key = file.path[len(str(folder)) + 1 :]
        if key not in known and file.is_file(follow_symlinks=False):
            with suppress(OSError):
                new[key] = _current(file.path, file.stat(), None)
    if new:
        _write(folder, known | new)


def _current(path: str, state: os.stat_result, entry: Entry | None) -> Entry | None:
    """The entry that describes a file now; None if it contradicts the recorded entry."""
    identity = [state.st_size, state.st_ctime_ns, state.st_ino]
    if entry is not None and entry[1:] == identity:
        return entry
    checksum = zlib.crc32(Path(path).read_bytes())
    return [checksum, *identity] if entry is None or entry[0] == checksum else None


def _loaded(folder: Path, is_loaded: Callable[[str], bool]) -> Iterator[os.DirEntry[str]]:
    """Files of a folder and its subfolders with a name that the driver loads."""
    waiting = [str(folder)]
    while waiting:
        with suppress(OSError), os.scandir(waiting.pop()) as entries:
            for entry in entries:
                if is_loaded(entry.name):
                    yield entry
                elif entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)


def _remove(path: str | Path, state: os.stat_result) -> None:
    if stat.S_ISDIR(state.st_mode):
        shutil.rmtree(path)
    else:
        os.unlink(path)


def _read(folder: Path) -> dict[str, Entry] | None:
    """The recorded entries; empty without a record, None if it is damaged."""
    path = folder / _RECORD
    try:
        state = path.lstat()
        if not stat.S_ISREG(state.st_mode):
            _remove(path, state)
            return None
        record = json.loads(path.read_bytes())
    except OSError:
        return {}
    except ValueError:
        return None
    if not isinstance(record, dict):
        return None
    entries = {key: entry for key, entry in record.items() if isinstance(entry, list) and len(entry) == 4}
    return entries if record.get(_CHECKSUM, _checksum(entries)) == _checksum(entries) else None


def _write(folder: Path, entries: dict[str, Entry]) -> None:
    with suppress(InputError), atomic_write(folder / _RECORD) as stream:  # a folder that is read-only
        stream.write(json.dumps({**entries, _CHECKSUM: _checksum(entries)}).encode())


def _checksum(entries: dict[str, Entry]) -> int:
    return zlib.crc32(json.dumps(entries, sort_keys=True).encode())
