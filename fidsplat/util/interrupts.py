"""Cooperative cancellation: SIGINT and SIGTERM set a flag, and work stops at its next step.

The handler raises nothing. An exception from a handler arises between any two instructions: in a finalizer
or in a callback of a library, which drops it, so that the work goes on, or while a library loads, which
aborts the process. `check` raises instead, where work calls it. A second signal, half a second later or
more, raises at once, for work that has no step for long; a third ends the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

TYPE_CHECKING = False  # this module is loaded first of all: what takes long is imported late
if TYPE_CHECKING:
    import subprocess
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Future
    from types import FrameType
    from typing import IO, Any, TypeVar

    T = TypeVar("T")

PERIOD = 0.1
"""seconds between two looks at the flag of something that waits"""
REPEAT = 0.5
"""seconds in which a second signal is the first again: `timeout` and shells send to a process and to its
group"""

_number: int | None = None
"""of the signal that came"""
_since = 0.0
"""when it came, time.monotonic()"""
_postponed = 0


class Terminated(KeyboardInterrupt):
    """SIGTERM, which stops a command as Ctrl-C does: half-written files are removed."""


def install() -> dict[int, Any]:
    """Let SIGINT and SIGTERM set the flag; returns the handlers that are replaced.

    Signals that are ignored stay ignored, as those of a command that a shell starts in the background.
    Outside the main thread nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # None: not set by Python
    return {
        n: signal.signal(n, _handle)
        for n, own in before.items()
        if own not in (signal.SIG_IGN, None, _handle)
    }


@contextlib.contextmanager
def handled() -> Iterator[None]:
    """SIGINT and SIGTERM set the flag within the block."""
    global _number
    before = install()
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)
        if before:
            _number = None


def check() -> None:
    """A step of work: raises KeyboardInterrupt, or Terminated, in the main thread once a signal came."""
    if _number is not None and not _postponed and threading.current_thread() is threading.main_thread():
        raise _stop(_number)


@contextlib.contextmanager
def postponed() -> Iterator[Callable[[], KeyboardInterrupt | None]]:
    """Within the block `check` raises nothing, so that work is finished or saved; yields what returns the
    exception to raise once a signal came, and None before."""
    global _postponed
    _postponed += 1
    try:
        yield lambda: None if _number is None else _stop(_number)
    finally:
        _postponed -= 1


def result_of(future: Future[T]) -> T:
    """The result of a task in another thread; waiting for it can be interrupted."""
    from concurrent.futures import wait

    while not wait([future], PERIOD).done:
        check()
    return future.result()


def sleep(seconds: float) -> None:
    """Sleep; `check` ends it early."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        check()
        time.sleep(min(left, PERIOD))


def run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a process to its end with its output captured as text; it is killed when this is interrupted."""
    import subprocess

    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, errors="replace") as process:
        try:
            while True:
                check()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    out, err = process.communicate(timeout=PERIOD)
                    check()  # Ctrl-C in a terminal ends the process too
                    return subprocess.CompletedProcess(command, process.returncode, out, err)
        except BaseException:
            process.kill()
            raise


def lines_of(pipe: IO[bytes]) -> Iterator[str]:
    """The lines of a process's output as they come; waiting for them can be interrupted."""
    import select

    rest = b""
    while True:
        while not select.select([pipe], [], [], PERIOD)[0]:
            check()
        if not (part := os.read(pipe.fileno(), 2**16)):
            return
        *lines, rest = (rest + part).split(b"\n")
        yield from (line.decode("utf-8", "replace") for line in lines)


def _handle(number: int, frame: FrameType | None) -> None:
    global _number, _since
    if _number is None:
        _number, _since = number, time.monotonic()
    elif time.monotonic() - _since > REPEAT:
        signal.signal(number, signal.SIG_DFL)
        raise _stop(_number)


def _stop(number: int) -> KeyboardInterrupt:
    return Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
