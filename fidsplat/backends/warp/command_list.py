"""Kernel launches with times by stage: divided over threads on the CPU, captured as CUDA graphs on GPUs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from itertools import pairwise
from typing import Any

from fidsplat.backends.warp.runtime import load
from fidsplat.backends.warp.workspace import Workspace

BLOCK = 256
"""default threads per block on a GPU"""
_MIN_THREADS = 2048
"""minimum threads of one part of a CPU launch; smaller parts cost more time than they save"""
_MIN_TILES = 4
"""minimum tiles or blocks of one part of a CPU launch"""


@cache
def _parameters(kernel: Any) -> tuple[str, ...]:
    return tuple(argument.label for argument in kernel.adj.args)


def _arguments(kernel: Any, arguments: Mapping[str, Any], first: int = 0) -> list[Any]:
    """Arguments of a kernel in the order of its parameters, from parameter number `first` on."""
    return [arguments[name] for name in _parameters(kernel)[first:]]


class LaunchCache:
    """Cache of the last launch of each kernel, so that only changed arguments are packed again."""

    def __init__(self, device: Any, threads: int) -> None:
        """threads: number of host threads for launches on the CPU."""
        self.device, self.threads = device, threads
        # a CPU launch runs on the calling thread and releases the GIL
        self.workers = None if device.is_cuda else ThreadPoolExecutor(threads, "fidsplat-warp")
        self._wp = load()
        self._launches: dict[tuple[Any, int], tuple[Any, list[Any], list[int]]] = {}

    def release_arrays(self) -> None:
        """Discard the cached launches and release their arrays."""
        self._launches.clear()

    def launch(self, kernel: Any, count: int, args: list[Any], block: int = BLOCK) -> None:
        """Launch `count` threads of a kernel, in blocks of `block` on a GPU."""
        cached = self._launches.get((kernel, block))
        if cached is None:
            options = {"device": self.device, "block_dim": block, "record_tape": False, "record_cmd": True}
            command = self._wp.launch(kernel, count, args, **options)
            self._launches[kernel, block] = command, list(args), [count]
        else:
            command, before, dim = cached
            for index, value in enumerate(args):
                if value is not before[index]:
                    command.set_param_at_index(index, value)
                    before[index] = value  # a reference to the value, as the command stores only its address
            if dim[0] != count:
                command.set_dim(count)
                dim[0] = count
        command.launch()


class Launcher:
    """Launches of one frame, with arguments by the names of the kernels' parameters."""

    def __init__(self, cache: LaunchCache, timed: bool = True, divided: bool = True) -> None:
        """timed: measure the stages. divided: divide CPU launches over threads."""
        self._wp, self.timed = load(), timed
        self._device, self._workers, self._cache = cache.device, cache.workers, cache
        self.parts = 8 * cache.threads if divided else 1
        """number of parts of a CPU launch: several per thread, for load balancing"""
        self._stream = None if self._workers else self._device.stream  # the caller may switch it later
        self._marks: list[tuple[str | None, Any]] = []

    def launch(self, kernel: Any, count: int, arguments: Mapping[str, Any], block: int = BLOCK) -> None:
        """Launch `count` threads of a kernel whose first parameter is the index of its first thread."""
        args = _arguments(kernel, arguments, 1)
        parts = 1 if self._workers is None else min(self.parts, -(-count // _MIN_THREADS))
        if parts == 1:
            self._cache.launch(kernel, count, [0, *args], block)
            return
        cuts = [count * k // parts for k in range(parts + 1)]
        self._run(kernel, [(end - first, [first, *args]) for first, end in pairwise(cuts)])

    def launch_undivided(
        self, kernel: Any, count: int, arguments: Mapping[str, Any], block: int = BLOCK
    ) -> None:
        """Launch `count` threads undivided on every device, with all arguments from `arguments`."""
        self._cache.launch(kernel, count, _arguments(kernel, arguments), block)

    def launch_blocks(
        self,
        kernel: Any,
        first: int,
        end: int,
        arguments: Mapping[str, Any],
        block: int = BLOCK,
        area: int = 0,
    ) -> None:
        """Launch a block of threads on a GPU, or a thread on the CPU, for each number from first to end. The
        kernel's first parameter is the first number of a part of the launch. area: on the CPU, samples of
        state of a part, whose offset is the last parameter."""
        if self._workers is None:
            self._cache.launch(
                kernel, (end - first) * block, [first, *_arguments(kernel, arguments, 1)], block
            )
            return
        parts = min(self.parts, -(-(end - first) // _MIN_TILES))
        cuts = [first + (end - first) * k // parts for k in range(parts + 1)]
        args = _arguments(kernel, {**arguments, "state_first": 0}, 1)
        args = args[:-1] if area else args
        spans = enumerate(pairwise(cuts))
        self._run(kernel, [(b - a, [a, *args, *([k * area] if area else [])]) for k, (a, b) in spans])

    def _run(self, kernel: Any, parts: list[tuple[int, list[Any]]]) -> None:
        """Launch the parts of a kernel launch, each with its number of threads and arguments."""
        wp, device = self._wp, self._device

        def run(part: tuple[int, list[Any]]) -> None:
            wp.launch(kernel, *part, device=device, record_tape=False)

        if len(parts) == 1:
            self._cache.launch(kernel, *parts[0])
        elif self._workers is not None:
            list(self._workers.map(run, parts))  # raises the exception of a part

    def read_back(self, totals: Any, host: Any) -> list[int]:
        """Copy a few integers from the device through the array `host` of the same length, and wait."""
        self._wp.copy(host, totals)
        self.finish()
        return host.numpy().tolist()

    def finish(self) -> None:
        if self._stream is not None:
            self._wp.synchronize_stream(self._stream)

    def stage(self, name: str | None) -> None:
        """Start timing the stage `name`, and end the current one. None: only end it."""
        if not self.timed:
            return
        if self._workers is None:
            mark = self._wp.Event(self._device, enable_timing=True)
            self._wp.record_event(mark)
        else:
            mark = time.perf_counter()
        self._marks.append((name, mark))

    def timings(self) -> dict[str, float]:
        """Milliseconds by stage, in the order in which they first ran."""
        timings: dict[str, float] = {}
        for (name, begin), (_, end) in pairwise(self._marks):
            if name is None:  # between a frame and its derivatives
                continue
            if self._workers is None:
                took = self._wp.get_event_elapsed_time(begin, end)
            else:
                took = (end - begin) * 1e3
            timings[name] = timings.get(name, 0.0) + took
        return timings


def capture(workspace: Workspace, launch: Callable[[], object]) -> Any:
    """Capture the launches of `launch` as a CUDA graph, without running them. Returns None after a warning if
    the device cannot capture; later frames are then not captured either."""
    wp, device = load(), workspace.device
    try:
        # a separate stream, as the caller's current stream may not support capture
        with wp.ScopedStream(workspace.capture_stream, sync_enter=False):
            wp.capture_begin(device=device)
            try:
                launch()
            except BaseException:
                with suppress(RuntimeError):
                    wp.capture_end(device=device)
                raise
            return wp.capture_end(device=device)
    except RuntimeError as error:
        workspace.replays = False
        warnings.warn(
            f"{workspace.name} captures no graphs ({str(error).strip()}); each frame's kernels are "
            "launched one by one, with bit-identical images",
            stacklevel=2,
        )
        return None
