"""Access to an open device for tests: single kernels of kernels/warp/check.py, and arrays filled with NaN."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fidsplat.backends.probing import Probe
from fidsplat.backends.warp.pipeline import WarpPipeline
from fidsplat.backends.warp.runtime import kernels, load, quiet
from fidsplat.backends.warp.workspace import ArrayPool, Workspace, nbytes
from fidsplat.util.errors import DeviceError


class WarpProbe(Probe):
    fuses = True
    """always true: Warp fuses multiply-adds where requested"""

    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        n = len(a)
        types = (np.float32, np.float32, np.float64, np.float32)
        return run(self._workspace, "contraction", n, (a, b, a), [np.zeros(n, each) for each in types])

    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        (found,) = run(self._workspace, "not_a_number", len(x), (x,), [np.zeros((4, len(x)), np.int32)])
        return list(found)

    def arithmetic(
        self, exponents: np.ndarray, fractions: np.ndarray, dividends: np.ndarray, divisors: np.ndarray
    ) -> dict[str, np.ndarray]:
        workspace, n = self._workspace, len(exponents)
        single = [array.astype(np.float32) for array in (exponents, fractions, dividends, divisors)]
        (found,) = run(workspace, "arithmetic", n, single, [np.zeros((8, n), np.float32)])
        names = ("exp", "log", "division", "sqrt", "fma", "fast_exp", "fast_log", "reciprocal")
        results: dict[str, np.ndarray] = dict(zip(names, found, strict=True))
        (found,) = run(workspace, "arithmetic_wide", n, [dividends, divisors], [np.zeros((3, n))])
        results |= dict(zip(("division64", "sqrt64", "log64"), found, strict=True))
        smallest = np.array([np.finfo(np.float32).tiny, 0.5], np.float32)
        (results["denormal"],) = run(workspace, "denormal", 1, [smallest], [np.zeros(2, np.float32)])
        return results

    def options(self) -> list[str]:
        return [name for name, value in kernels("common").STRICT.items() if value is True]

    def scan(self, pipeline: Any, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        wp, device = load(), self._workspace.device
        with wp.ScopedDevice(device):
            given = wp.array(lengths.astype(np.int64), dtype=wp.int64, device=device)
            ends = wp.zeros_like(given)
            wp.utils.array_scan(given, ends, inclusive=True)
        places = np.concatenate([[0], ends.numpy()])
        return places.astype(np.uint32), int(places[-1])

    def bounding_boxes(self, pipeline: WarpPipeline, buffers: Mapping[str, np.ndarray]) -> np.ndarray:
        words = [pipeline.program.layout.word(name) for name in ("columns", "rows")]
        spans = buffers["records"].view(np.uint32)[:, words].astype(int)
        return np.stack([spans & 0xFFFF, spans >> 16], 2).reshape(-1, 4)

    def _poisoned_pool(self) -> ArrayPool:
        return PoisonedPool(self._workspace.device)


class PoisonedPool(ArrayPool):
    """A pool whose arrays are first filled with NaN."""

    def scratch(self, name: str, size: int, dtype: Any) -> Any:
        return poison(super().scratch(name, size, dtype))

    def allocate(self, name: str, size: int, dtype: Any) -> Any:
        return poison(super().allocate(name, size, dtype))


def poison(array: Any) -> Any:
    """Set all bytes of an array to 0xFF, and return it."""
    wp = load()
    wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(nbytes(array),), device=array.device).fill_(0xFF)
    return array


def run(
    workspace: Workspace, kernel: str, count: int, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Launch `count` threads of a kernel of kernels/warp/check.py on arrays, and return the output arrays."""
    wp, device = load(), workspace.device
    arrays = [wp.array(array, device=device) for array in (*inputs, *outputs)]
    try:
        with quiet():
            wp.launch(getattr(kernels("check"), kernel), count, arrays, device=device)
        return [array.numpy().copy() for array in arrays[len(inputs) :]]
    except RuntimeError as error:
        raise DeviceError(f"{workspace.name} failed in a test of its arithmetic: {error}") from error
