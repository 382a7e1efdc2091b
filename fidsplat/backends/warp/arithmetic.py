"""Runs the device's own functions on given numbers (kernels/warp/check.py)."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.warp.probe import run
from fidsplat.backends.warp.workspace import Workspace


def run_arithmetic(
    workspace: Workspace, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
) -> dict[str, np.ndarray]:
    """Results of the device's functions, as the stages call them.

    Args:
        exponents, shares, above, below: (n,) float64; they are rounded to float32 where float32 is computed.

    Returns:
        (n,) float32: `exp` of exponents, `log` of shares, `division` above / below, `sqrt` of below, `fma`
        above * below + above, `fast_exp` of exponents, `fast_log` of shares; (n,) float64: `division64`,
        `sqrt64`, `log64`; `denormal` (2,) float32: half of the smallest normal number, and twice that.

    Raises:
        DeviceError: the device cannot compile or run the kernels.
    """
    n = len(exponents)
    single = [array.astype(np.float32) for array in (exponents, shares, above, below)]
    (found,) = run(workspace, "arithmetic", n, single, [np.zeros((7, n), np.float32)])
    names = ("exp", "log", "division", "sqrt", "fma", "fast_exp", "fast_log")
    results: dict[str, np.ndarray] = dict(zip(names, found, strict=True))
    (found,) = run(workspace, "arithmetic_wide", n, [above, below], [np.zeros((3, n))])
    results |= dict(zip(("division64", "sqrt64", "log64"), found, strict=True))
    smallest = np.array([np.finfo(np.float32).tiny, 0.5], np.float32)
    (results["denormal"],) = run(workspace, "denormal", 1, [smallest], [np.zeros(2, np.float32)])
    return results
