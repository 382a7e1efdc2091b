"""Measurement of a device's peak rates for the roofline, with kernels/opencl/check/roofline.cl."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyopencl as cl

from fidsplat.backends.interface import Rates
from fidsplat.backends.opencl.program import compile_test_kernels
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.util.errors import DeviceError

_CHAINS = 8  # independent chains of operations per work-item, to hide latency (CHAINS in roofline.cl)
_REPEATS = 7
_SHORTEST = 8e-3  # seconds: minimum duration of a timed launch
_GROUP = 64


def measure_rates(workspace: Workspace) -> Rates:
    """Measure peak rates: the best of several launches each. Takes less than a second."""
    kernels = compile_test_kernels(workspace, "check/roofline.cl")
    try:
        return Rates(
            copy_bytes=_copy_rate(workspace, kernels["roofline_copy"]),
            fma=_operation_rate(workspace, kernels["roofline_fma"], 0.999, 0.001),
            exp=_operation_rate(workspace, kernels["roofline_exp"], 0.0, 0.0),
            division=_operation_rate(workspace, kernels["roofline_division"], 1.5, 0.0),
        )
    except cl.Error as error:
        raise DeviceError(f"{workspace.info.title} failed while its rates were measured: {error}") from error


def _copy_rate(workspace: Workspace, kernel: cl.Kernel) -> float:
    """Bytes per second of a copy, read plus written; the buffers exceed every cache."""
    size = 2**29 if workspace.info.kind == "gpu" else 2**27
    share = min(workspace.info.largest_allocation_bytes, workspace.info.memory_bytes) // 8
    size = min(size, share) // (16 * _GROUP) * 16 * _GROUP
    source, target = (workspace.pool.allocate("copied", size) for _ in range(2))
    cl.enqueue_fill_buffer(workspace.queue, source, np.zeros(1, np.float32), 0, size)
    items = size // 16
    best = _best(lambda: kernel(workspace.queue, (items,), (_GROUP,), source, target))
    return 2 * size / best


def _operation_rate(workspace: Workspace, kernel: cl.Kernel, a: float, b: float) -> float:
    # a GPU needs many work-items to hide its latencies; on a CPU a few groups per core are plenty
    groups = workspace.info.compute_units * (32 if workspace.info.kind == "gpu" else 4)
    items = groups * _GROUP
    out = workspace.pool.allocate("sums", 4 * items * workspace.config.lanes)

    def launch(rounds: int) -> cl.Event:
        return kernel(
            workspace.queue, (items,), (_GROUP,), np.uint32(rounds), np.float32(a), np.float32(b), out
        )

    rounds = 16
    while _seconds(launch(rounds)) < _SHORTEST and rounds < 2**24:
        rounds *= 2
    best = _best(lambda: launch(rounds))
    return items * workspace.config.lanes * _CHAINS * rounds / best


def _best(launch: Callable[[], cl.Event]) -> float:
    return min(_seconds(launch()) for _ in range(_REPEATS))


def _seconds(event: cl.Event) -> float:
    event.wait()
    return max(event.profile.end - event.profile.start, 1) * 1e-9
