"""Silence of libraries that write to the process's stderr on their own."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_lock = threading.Lock()
_users, _kept = 0, -1


@contextmanager
def without_stderr() -> Iterator[None]:
    """Discard what native code writes to file descriptor 2; threads may nest and overlap."""
    global _users, _kept
    with _lock:
        _users += 1
        if _users == 1:
            if sys.stderr is not None:
                sys.stderr.flush()
            try:
                _kept = os.dup(2)
            except OSError:  # it is closed: nothing is written
                _kept = -1
            else:
                nothing = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nothing, 2)
                os.close(nothing)
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if not _users and _kept >= 0:
                os.dup2(_kept, 2)
                os.close(_kept)
