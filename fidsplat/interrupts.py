"""Ctrl-C and SIGTERM as exceptions, at moments that can bear one."""

import contextlib
import signal
import threading
from abc import ABCMeta
from collections.abc import Callable, Iterator
from importlib.machinery import ExtensionFileLoader
from types import FrameType
from typing import Any

_UNFIT = frozenset(
    {
        ExtensionFileLoader.create_module.__code__,
        ExtensionFileLoader.exec_module.__code__,
        ABCMeta.__instancecheck__.__code__,
    }
)
"""what may not be interrupted, nor what it calls"""
_LATER = 0.01
"""seconds"""


class Terminated(KeyboardInterrupt):
    """SIGTERM, which stops a command where it stands as Ctrl-C does: half-written files are removed."""


@contextlib.contextmanager
def raised_in_time() -> Iterator[None]:
    """SIGINT raises KeyboardInterrupt and SIGTERM Terminated, but not while a library is being loaded, or
    asks what something is.

    What such a library calls of Python on its way (NumPy to register types, nanobind for its enums) may
    raise nothing that it does not expect: PyOpenCL aborts the process, NumPy reports a broken installation,
    others forget the interrupt. NumPy takes an interrupted question whether a file is a path for a yes. It
    comes again a little later.
    """
    # what a shell starts behind ignores Ctrl-C; None: not set by Python
    before = _handlers(lambda handler: handler not in (signal.SIG_IGN, None))
    with _handled(before, _stop):
        yield


@contextlib.contextmanager
def held_back() -> Iterator[Callable[[], KeyboardInterrupt | None]]:
    """The first SIGINT or SIGTERM waits: what is given returns the exception that it stands for, None where
    none has come, and is asked between two steps of some work, when nothing is half done. The next one does
    not wait."""
    asked: list[int] = []
    before = _handlers(callable)

    def hold(number: int, frame: FrameType | None) -> None:
        if asked:
            before[number](number, frame)
        asked.append(number)

    with _handled(before, hold):
        yield lambda: (Terminated() if asked[0] == signal.SIGTERM else KeyboardInterrupt()) if asked else None


def _handlers(replaced: Callable[[Any], bool]) -> dict[int, Any]:
    """Those of SIGINT and SIGTERM that may be replaced: none outside the main thread, which alone may handle
    signals."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    found = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    return {number: handler for number, handler in found.items() if replaced(handler)}


@contextlib.contextmanager
def _handled(before: dict[int, Any], handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Signals go to another handler than before."""
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, own in before.items():
            signal.signal(number, own)


def _stop(number: int, frame: FrameType | None) -> None:
    if not _is_unfit(frame):
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt
    again = threading.Timer(_LATER, signal.pthread_kill, (threading.main_thread().ident, number))
    again.daemon = True
    again.start()


def _is_unfit(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code not in _UNFIT:
        frame = frame.f_back
    return frame is not None
