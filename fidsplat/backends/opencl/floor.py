"""Times the kernels of kernels/opencl/check/floor.cl: what this device can do at best."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pyopencl as cl

from fidsplat.backends.base import Rates
from fidsplat.backends.opencl.assemble import kernel_text, with_scalars
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.opencl.backend import OpenCLBackend

_FILES = ("prelude.cl", "math.cl", "check/floor.cl")
_CHAINS = 8  # as in floor.cl
_REPEATS = 7
_SHORTEST = 8e-3  # seconds that a timed launch lasts at least
_GROUP = 64


def measure_rates(backend: OpenCLBackend) -> Rates:
    """The best of several launches each, with the vectors that the blend stage uses. Under a second.

    Raises:
        DeviceError: the device cannot compile or run the kernels.
    """
    lanes = backend.shape.lanes
    defines = {
        "LANES": lanes,
        "FAST_FMA": int(backend.shape.fast_fma),
        "SETUP_FP64": int(backend.info.float64),
    }
    text = "".join(f"#define {name} {value}\n" for name, value in defines.items())
    program = backend.build(with_scalars(text + "".join(map(kernel_text, _FILES))))
    kernels = {kernel.function_name: kernel for kernel in program.all_kernels()}
    try:
        return Rates(
            copy_bytes=_copy_rate(backend, kernels["floor_copy"]),
            fma=_operation_rate(backend, kernels["floor_fma"], 0.999, 0.001),
            exp=_operation_rate(backend, kernels["floor_exp"], 0.0, 0.0),
            division=_operation_rate(backend, kernels["floor_division"], 1.5, 0.0),
        )
    except cl.Error as error:
        raise DeviceError(f"{backend.info.title} failed while its rates were measured: {error}") from error


def _copy_rate(backend: OpenCLBackend, kernel: cl.Kernel) -> float:
    """Bytes per second, those read and those written together; buffers that no cache holds."""
    wanted = 2**29 if backend.info.kind == "gpu" else 2**27
    share = min(backend.info.largest_allocation_bytes, backend.info.memory_bytes) // 8
    size = min(wanted, share) // (16 * _GROUP) * 16 * _GROUP
    source, target = (backend.pool.fresh("copy of the floor", size) for _ in range(2))
    cl.enqueue_fill_buffer(backend.queue, source, np.zeros(1, np.float32), 0, size)
    items = size // 16
    best = _best(lambda: kernel(backend.queue, (items,), (_GROUP,), source, target))
    return 2 * size / best


def _operation_rate(backend: OpenCLBackend, kernel: cl.Kernel, a: float, b: float) -> float:
    """Results per second."""
    # a GPU needs many work-items to hide its latencies; on a CPU a few groups per core are plenty
    groups = backend.info.compute_units * (32 if backend.info.kind == "gpu" else 4)
    items = groups * _GROUP
    out = backend.pool.fresh("sums of the floor", 4 * items * backend.shape.lanes)

    def launch(rounds: int) -> cl.Event:
        return kernel(
            backend.queue, (items,), (_GROUP,), np.uint32(rounds), np.float32(a), np.float32(b), out
        )

    rounds = 16
    while _seconds(launch(rounds)) < _SHORTEST and rounds < 2**24:
        rounds *= 2
    best = _best(lambda: launch(rounds))
    return items * backend.shape.lanes * _CHAINS * rounds / best


def _best(launch: Callable[[], cl.Event]) -> float:
    return min(_seconds(launch()) for _ in range(_REPEATS))


def _seconds(event: cl.Event) -> float:
    event.wait()
    return max(event.profile.end - event.profile.start, 1) * 1e-9
