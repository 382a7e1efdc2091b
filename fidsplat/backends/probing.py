"""Access to an open device for tests: single functions, single stages, and poisoned memory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

import numpy as np


class Probe(ABC):
    """Small kernels compiled as the stages are, single stages on made-up input, and poisoned memory."""

    fuses: bool
    """whether the device fuses multiply-adds where requested"""

    @abstractmethod
    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        """a b - a b; a b + a; a b - a b of thirds in the precision of the set-up; a b - (a b), fused: each
        (n,), from a, b (n,) float32."""

    @abstractmethod
    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """x != x, isnan, fails every comparison, isinf; each (n,) int32, from x (n,) float32."""

    @abstractmethod
    def arithmetic(
        self, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Results of the device's functions, float32 ones as in the stages.

        Args:
            exponents, shares, above, below: (n,) float64, n a multiple of 16; they are rounded to float32
                for float32 functions.

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
        """Prefix sums of list lengths (n,) uint32, modulo 2^32, (n + 1,) uint32; and the total in 64 bits."""

    @abstractmethod
    def boxes(self, pipeline: Any, trace: Mapping[str, np.ndarray]) -> np.ndarray:
        """Bounding boxes of the splats of a `Pipeline.trace` in samples, (n, 4) int, columns [x0, x1) and
        rows [y0, y1); undefined for culled splats."""

    @abstractmethod
    def poisoned(self) -> AbstractContextManager[None]:
        """A context in which all memory that a frame allocates is first filled with 0xFF: NaN, or -1."""
