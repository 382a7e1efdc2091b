"""Looks into an open device: single kernels of kernels/warp/check.py, and arrays that are filled with rubbish
first.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.backends.warp import runtime
from fidsplat.backends.warp.workspace import ArrayPool
from fidsplat.errors import DeviceError

if TYPE_CHECKING:
    from fidsplat.backends.warp.device import WarpBackend
    from fidsplat.backends.warp.pipeline import WarpPipeline


def run(
    backend: WarpBackend, kernel: str, count: int, inputs: Sequence[np.ndarray], outputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Launch `count` threads of a kernel of kernels/warp/check.py on arrays; what stands in `outputs`
    afterwards.

    Raises:
        DeviceError: the compiler refuses, or the device fails.
    """
    wp = runtime.load()
    arrays = [wp.array(array, device=backend.device) for array in (*inputs, *outputs)]
    try:
        with runtime.quiet():
            wp.launch(getattr(runtime.kernels("check"), kernel), count, arrays, device=backend.device)
        return [array.numpy().copy() for array in arrays[len(inputs) :]]
    except RuntimeError as error:
        raise DeviceError(f"{backend.info.name} failed in a test of its arithmetic: {error}") from error


def contraction(backend: WarpBackend, a: np.ndarray, b: np.ndarray) -> tuple[list[np.ndarray], bool]:
    """a b - a b; a b + a; (a / 3) (b / 3) - (a / 3) (b / 3) in float64; a b - (a b), fused: each (n,), from
    a, b (n,) float32.
    And whether the device fuses where it is asked to.
    """
    n = len(a)
    types = (np.float32, np.float32, np.float64, np.float32)
    return run(backend, "contraction", n, (a, b, a), [np.zeros(n, each) for each in types]), True


def not_a_number(backend: WarpBackend, x: np.ndarray) -> Sequence[np.ndarray]:
    """Of x (n,) float32: x != x, isnan, fails every comparison, isinf; each (n,) int32."""
    (found,) = run(backend, "not_a_number", len(x), (x,), [np.zeros((4, len(x)), np.int32)])
    return list(found)


def options(backend: WarpBackend) -> list[str]:
    """What every kernel is compiled with, switches that are on."""
    return [name for name, value in runtime.kernels("common").STRICT.items() if value]


def scan(pipeline: WarpPipeline, lengths: np.ndarray) -> tuple[np.ndarray, int]:
    """Where lists of these lengths (n,) uint32 start, modulo 2^32, (n + 1,) uint32; and the sum of all in 64
    bits.
    """
    wp, device = runtime.load(), pipeline.workspace.device
    with wp.ScopedDevice(device):
        given = wp.array(lengths.astype(np.int64), dtype=wp.int64, device=device)
        ends = wp.zeros_like(given)
        wp.utils.array_scan(given, ends, inclusive=True)
    places = np.concatenate([[0], ends.numpy()])
    return places.astype(np.uint32), int(places[-1])


@contextmanager
def poisoned(backend: WarpBackend) -> Iterator[None]:
    """Within it, every array that a picture takes is filled with 0xFF first: NaN, or the integer -1."""
    pool = backend.workspace.pool
    backend.workspace.pool = PoisonedPool(backend.device)
    try:
        yield
    finally:
        backend.workspace.pool = pool


class PoisonedPool(ArrayPool):
    """A pool whose arrays hold nothing useful."""

    def scratch(self, name: str, size: int, dtype: Any) -> Any:
        return poison(super().scratch(name, size, dtype))

    def fresh(self, name: str, size: int, dtype: Any) -> Any:
        return poison(super().fresh(name, size, dtype))


def poison(array: Any) -> Any:
    """The array, its bytes all 0xFF."""
    wp = runtime.load()
    size = array.size * array.strides[0]
    wp.array(ptr=array.ptr, dtype=wp.uint8, shape=(size,), device=array.device).fill_(0xFF)
    return array
