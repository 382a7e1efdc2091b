"""Compilation of programs in the background."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Hashable
from contextlib import suppress

import pyopencl as cl

from fidsplat.backends.opencl.program import in_background
from fidsplat.util.errors import FidsplatError


class BackgroundCompiler:
    """Compiles programs one after another in background threads; drivers release the GIL while compiling.

    Each thread compiles one program: a process that exits meanwhile, after Ctrl-C for example, waits for it.
    """

    def __init__(self) -> None:
        self._threads: dict[Hashable, threading.Thread] = {}

    def begin(self, key: Hashable, compile: Callable[[], object]) -> None:
        """Start to compile. Errors are ignored here: the program is compiled again when it is needed, and the
        error is raised then."""
        if key in self._threads:
            return
        # not in the thread: `build` changes the filters of all threads
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
        """Wait until the compilation of a key has ended, if it has begun."""
        thread = self._threads.get(key)
        if thread is not None and thread is not threading.current_thread():
            thread.join()
            self._threads.pop(key, None)
