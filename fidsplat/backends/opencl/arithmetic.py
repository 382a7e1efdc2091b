"""Runs the device's own functions on given numbers (kernels/opencl/check/arithmetic.cl)."""

from __future__ import annotations

import numpy as np
import pyopencl as cl

from fidsplat.backends.opencl.assemble import section_text
from fidsplat.backends.opencl.program import check_kernels
from fidsplat.backends.opencl.workspace import Workspace
from fidsplat.errors import DeviceError


def run_arithmetic(
    workspace: Workspace, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
) -> dict[str, np.ndarray]:
    """Results of the device's functions, float32 ones as the blend stage calls them.

    Args:
        exponents, shares, above, below: (n,) float64, n a multiple of 16; they are rounded to float32 where
            float32 is computed.

    Returns:
        (n,) float32: `exp` of exponents, `log` of shares, `division` above / below, `sqrt` of below, `fma`
        above * below + above, `fast_exp` of exponents, `fast_log` of shares; (n,) float64 where
        the device has it: `division64`, `sqrt64`, `log64`; `denormal` (2,) float32: half of the smallest
        normal number, and twice that.

    Raises:
        DeviceError: the device cannot compile or run the kernels.
    """
    arithmetic = section_text("slot/arithmetic_fast.cl", "arithmetic")
    kernels = check_kernels(workspace, "check/arithmetic.cl", arithmetic=arithmetic)
    n = len(exponents)
    single = [array.astype(np.float32) for array in (exponents, shares, above, below)]
    try:
        planes = _run(workspace, kernels["arithmetic_float"], n // workspace.shape.lanes, n, single, 7)
        names = ("exp", "log", "division", "sqrt", "fma", "fast_exp", "fast_log")
        results: dict[str, np.ndarray] = dict(zip(names, planes, strict=True))
        if workspace.info.float64:
            planes = _run(workspace, kernels["arithmetic_real"], n, n, [above, below], 3)
            results |= dict(zip(("division64", "sqrt64", "log64"), planes, strict=True))
        smallest = np.array([np.finfo(np.float32).tiny, 0.5], np.float32)
        given, out = (workspace.pool.fresh("arithmetic", 16) for _ in range(2))
        cl.enqueue_copy(workspace.queue, given, smallest)
        kernels["arithmetic_denormal"](workspace.queue, (1,), (1,), given, out)
        results["denormal"] = np.empty(2, np.float32)
        cl.enqueue_copy(workspace.queue, results["denormal"], out)
    except cl.Error as error:
        raise DeviceError(f"{workspace.info.title} failed in a test of its arithmetic: {error}") from error
    return results


def _run(
    workspace: Workspace, kernel: cl.Kernel, items: int, n: int, inputs: list[np.ndarray], outputs: int
) -> np.ndarray:
    buffers = []
    for array in inputs:
        buffers.append(workspace.pool.fresh("arithmetic", array.nbytes))
        cl.enqueue_copy(workspace.queue, buffers[-1], array)
    planes = np.empty((outputs, n), inputs[0].dtype)
    out = workspace.pool.fresh("arithmetic", planes.nbytes)
    kernel(workspace.queue, (items,), None, np.uint32(n), *buffers, out)
    cl.enqueue_copy(workspace.queue, planes, out)
    return planes
