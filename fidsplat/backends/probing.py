"""Interface for tests of an open device: single functions, single stages, and poisoned memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np


class Probe(ABC):
    """Access for tests: small kernels compiled like the stages, stages on artificial input, poisoned
    memory."""

    def __init__(self, workspace: Any) -> None:
        self._workspace = workspace

    fuses: bool
    """whether the device fuses multiply-adds where requested"""

    @abstractmethod
    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        """Evaluate expressions that a compiler may contract to fused multiply-adds, from a, b (n,) float32.

        Returns:
            Four arrays (n,): a b - a b; a b + a; (a/3)(b/3) - (a/3)(b/3) in the precision of the set-up;
            fma(a, b, -(a b)).
        """

    @abstractmethod
    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """Test x (n,) float32 for NaN and infinity in four ways, each (n,) int32: x != x, isnan, every
        comparison is false, isinf."""

    @abstractmethod
    def arithmetic(
        self, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Evaluate the device's mathematical functions, compiled as in the stages.

        Args:
            exponents, shares, above, below: (n,) float64 arguments, n a multiple of 16; rounded to float32
                for functions in float32.

        Returns:
            (n,) float32: `exp` of exponents, `log` of shares, `division` above / below, `sqrt` of below,
            `fma` above * below + above, `fast_exp` of exponents, `fast_log` of shares; (n,) float64 where the
            device has it: `division64`, `sqrt64`, `log64`; `denormal` (2,) float32: half of the smallest
            normal number, and twice that.

        Raises:
            DeviceError: the device cannot compile or run the kernels.
        """

    @abstractmethod
    def options(self) -> list[str]:
        """Compiler options of every kernel."""

    @abstractmethod
    def scan(self, pipeline: Any, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        """Run the prefix sum of the tile lists on lengths (n,) uint32: sums modulo 2^32, (n + 1,) uint32, and
        the total in 64 bits."""

    @abstractmethod
    def boxes(self, pipeline: Any, trace: Mapping[str, np.ndarray]) -> np.ndarray:
        """Bounding boxes of the splats of a `Pipeline.trace` in samples, (n, 4) int, columns [x0, x1) and
        rows [y0, y1); undefined for culled splats."""

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
