"""Standard streams of the process: replace closed ones, and discard output."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator

_lock = threading.Lock()
_users, _copy = 0, -1


def open_missing() -> None:
    """Replace a closed stdin, stdout or stderr by the null device; otherwise the next opened file would have
    its descriptor, and receive the output."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            # open() uses the lowest free descriptor, which is the missing one
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 it stays open


def discard_stdout() -> None:
    """Discard further output on stdout, including Python's final flush."""
    with contextlib.suppress(OSError, ValueError):  # a stream without a descriptor has no final flush
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextlib.contextmanager
def without_stderr() -> Iterator[None]:
    """Discard output of native code to file descriptor 2. Calls of several threads may nest and overlap."""
    global _users, _copy
    with _lock:
        _users += 1
        if _users == 1:
            if sys.stderr is not None:
                sys.stderr.flush()
            try:
                _copy = os.dup(2)
            except OSError:  # stderr is closed
                _copy = -1
            else:
                nothing = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nothing, 2)
                os.close(nothing)
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if not _users and _copy >= 0:
                os.dup2(_copy, 2)
                os.close(_copy)
