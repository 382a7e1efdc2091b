"""Programs that are compiled while others run, in a thread of their own."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Hashable
from contextlib import suppress

import pyopencl as cl

from fidsplat.backends.opencl.program import in_background
from fidsplat.util.errors import FidsplatError


class Ahead:
    """What is compiled before it is needed, one after another.

    Drivers compile without Python's lock. A thread ends with what it compiles: a program that ends meanwhile,
    by Ctrl-C say, waits so long and no longer.
    """

    def __init__(self) -> None:
        self._threads: dict[Hashable, threading.Thread] = {}

    def begin(self, key: Hashable, compile: Callable[[], object]) -> None:
        """Compiles in the background. What fails there is compiled, and fails, where it is needed."""
        if key in self._threads:
            return
        # here, since what `build` does for the main thread is not for two at once
        warnings.filterwarnings("ignore", category=cl.CompilerWarning)
        before = list(self._threads.values())

        def work() -> None:
            in_background.on = True
            for other in before:
                other.join()
            with suppress(FidsplatError, cl.Error):
                compile()

        self._threads[key] = thread = threading.Thread(target=work, name="fidsplat compiles", daemon=False)
        thread.start()

    def wait(self, key: Hashable) -> None:
        """Until what was begun is done."""
        thread = self._threads.get(key)
        if thread is not None and thread is not threading.current_thread():
            thread.join()
            self._threads.pop(key, None)
