"""Interface for tests of a device: single functions, single stages, and memory filled with NaN."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np


class Probe(ABC):
    """Access to a device for tests."""

    def __init__(self, workspace: Any) -> None:
        self._workspace = workspace

    fuses: bool
    """whether the device fuses multiply-adds where requested"""

    @abstractmethod
    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        """Four expressions that a compiler may contract to fused multiply-adds, for a, b (n,) float32: a b -
        a b; a b + a; (a/3)(b/3) - (a/3)(b/3) in the precision of the projection; fma(a, b, -(a b))."""

    @abstractmethod
    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """Tests of x (n,) float32, as int32: x != x; isnan; every comparison is false; isinf."""

    @abstractmethod
    def arithmetic(
        self, exponents: np.ndarray, fractions: np.ndarray, dividends: np.ndarray, divisors: np.ndarray
    ) -> dict[str, np.ndarray]:
        """The device's mathematical functions, compiled as in the stages, for arguments (n,) float64, n a
        multiple of 16.

        Returns (n,) float32: `exp` and `fast_exp` of exponents, `log` and `fast_log` of fractions, `division`
        dividends / divisors, `sqrt` and `reciprocal` of divisors, `fma` dividends * divisors + dividends;
        (n,) float64 if the device has it: `division64`, `sqrt64`, `log64`; `denormal` (2,) float32: half of
        the smallest normal number, and twice that.
        """

    @abstractmethod
    def options(self) -> list[str]:
        """Compiler options of every kernel."""

    @abstractmethod
    def scan(self, pipeline: Any, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        """Prefix sums modulo 2^32 of list lengths (n,) uint32: (n + 1,) uint32; and the total."""

    @abstractmethod
    def bounding_boxes(self, pipeline: Any, buffers: Mapping[str, np.ndarray]) -> np.ndarray:
        """Bounding boxes (n, 4) int in samples of the splats, from a result of
        `Pipeline.render_intermediates`: columns [x0, x1), rows [y0, y1); undefined for culled splats."""

    @contextmanager
    def poisoned(self) -> Iterator[None]:
        """A context in which the memory that a frame allocates is first filled with 0xFF (NaN, or -1)."""
        pool = self._workspace.pool
        self._workspace.pool = self._poisoned_pool()
        try:
            yield
        finally:
            self._workspace.pool = pool

    @abstractmethod
    def _poisoned_pool(self) -> Any:
        """A memory pool whose memory is first filled with 0xFF."""
