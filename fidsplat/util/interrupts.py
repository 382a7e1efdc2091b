"""Cooperative cancellation: SIGINT and SIGTERM set a flag, and work stops at its next call of `check`.

The handler does not raise, as its exception could interrupt any code: a finalizer or a callback of a library
would discard it, and a library that is being loaded would abort the process. A second signal, at least half a
second later, raises immediately, for work that seldom calls `check`. A third signal ends the process.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

TYPE_CHECKING = False  # not imported from typing: this module is loaded first, before slow imports
if TYPE_CHECKING:
    import subprocess
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from concurrent.futures import Future
    from types import FrameType
    from typing import IO, Any, TypeVar

    T = TypeVar("T")

PERIOD = 0.1
"""seconds between two checks of the flag while waiting"""
REPEAT = 0.5
"""seconds in which a second signal counts as a duplicate, as `timeout` and shells signal a process and also
its group"""

_number: int | None = None
"""number of the received signal"""
_since = 0.0
"""time.monotonic() of the signal"""
_postponed = 0
"""number of active `postponed` blocks"""


class Terminated(KeyboardInterrupt):
    """Exception for SIGTERM, which stops a command like Ctrl-C, so that incomplete files are removed."""


def install() -> dict[int, Any]:
    """Let SIGINT and SIGTERM set the flag, unless they are ignored, and return the replaced handlers; does
    nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    # None: not set by Python
    return {
        n: signal.signal(n, _handle)
        for n, handler in before.items()
        if handler not in (signal.SIG_IGN, None, _handle)
    }


@contextlib.contextmanager
def handled() -> Iterator[None]:
    """Let SIGINT and SIGTERM set the flag within the block."""
    global _number
    before = install()
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if before:
            _number = None


def check() -> None:
    """Raise KeyboardInterrupt or Terminated after a signal, in the main thread; work calls it regularly."""
    if _number is not None and not _postponed and threading.current_thread() is threading.main_thread():
        raise _stop(_number)


@contextlib.contextmanager
def postponed() -> Iterator[Callable[[], KeyboardInterrupt | None]]:
    """Disable `check` within the block, so that work is completed or saved. Yields a function that returns
    the exception of a received signal, or None."""
    global _postponed
    _postponed += 1
    try:
        yield lambda: None if _number is None else _stop(_number)
    finally:
        _postponed -= 1


def result_of(future: Future[T]) -> T:
    """Wait for the result of a task in another thread; signals interrupt the waiting."""
    from concurrent.futures import wait

    while not wait([future], PERIOD).done:
        check()
    return future.result()


def ordered_results(futures: Iterable[Future[T]], pending: int) -> Iterator[T]:
    """Results of tasks in submission order; an iterable submits them one by one; at most `pending` tasks are
    submitted in advance. Signals interrupt the waiting."""
    from collections import deque

    waiting: deque[Future[T]] = deque()
    for future in futures:
        waiting.append(future)
        if len(waiting) > pending:
            yield result_of(waiting.popleft())
    while waiting:
        yield result_of(waiting.popleft())


def sleep(seconds: float) -> None:
    """Sleep for a time; signals interrupt it."""
    end = time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        check()
        time.sleep(min(left, PERIOD))


def run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a process and capture its output as text; a signal kills it."""
    import subprocess

    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, errors="replace") as process:
        try:
            while True:
                check()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    out, err = process.communicate(timeout=PERIOD)
                    check()  # Ctrl-C in a terminal also ends the process
                    return subprocess.CompletedProcess(command, process.returncode, out, err)
        except BaseException:
            process.kill()
            raise


def lines_of(pipe: IO[bytes]) -> Iterator[str]:
    """Lines of a process's output; signals interrupt the waiting."""
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
