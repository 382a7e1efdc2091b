"""What a backend offers to tests alone: looks into its device, and other build constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.interface import Backend, Pipeline
from fidsplat.effects import FeatureSet


class Probe(Protocol):
    """Looks into an open device: small kernels compiled as the stages are, single stages on made-up input,
    and memory that is filled with rubbish first."""

    @property
    def fuses(self) -> bool:
        """Whether the device fuses multiply-adds where it is asked to."""
        ...

    def contraction(self, a: np.ndarray, b: np.ndarray) -> Sequence[np.ndarray]:
        """a b - a b; a b + a; the difference in the set-up's precision, of thirds; a b - (a b), fused: each
        (n,), from a, b (n,) float32."""
        ...

    def not_a_number(self, x: np.ndarray) -> Sequence[np.ndarray]:
        """Of x (n,) float32: x != x, isnan, fails every comparison, isinf; each (n,) int32."""
        ...

    def arithmetic(
        self, exponents: np.ndarray, shares: np.ndarray, above: np.ndarray, below: np.ndarray
    ) -> dict[str, np.ndarray]:
        """Results of the device's functions, float32 ones as the stages call them.

        Args:
            exponents, shares, above, below: (n,) float64, n a multiple of 16; they are rounded to float32
                where float32 is computed.

        Returns:
            (n,) float32: `exp` of exponents, `log` of shares, `division` above / below, `sqrt` of below,
            `fma` above * below + above, `fast_exp` of exponents, `fast_log` of shares; (n,) float64 where the
            device has it: `division64`, `sqrt64`, `log64`; `denormal` (2,) float32: half of the smallest
            normal number, and twice that.

        Raises:
            DeviceError: the device cannot compile or run the kernels.
        """
        ...

    def options(self) -> list[str]:
        """What every kernel is compiled with."""
        ...

    def scan(self, pipeline: Any, lengths: np.ndarray) -> tuple[np.ndarray, int]:
        """Where lists of these lengths (n,) uint32 start, modulo 2^32, (n + 1,) uint32; and the sum of all in
        64 bits."""
        ...

    def boxes(self, pipeline: Any, trace: Mapping[str, np.ndarray]) -> np.ndarray:
        """Of what `pipeline.trace` gave: the samples that each splat can touch, (n, 4) int, columns [x0, x1)
        and rows [y0, y1); undefined for culled splats."""
        ...

    def poisoned(self) -> AbstractContextManager[None]:
        """Within it, all memory that a picture takes is filled with 0xFF first: NaN, or the integer -1."""
        ...


@runtime_checkable
class Probed(Protocol):
    """A backend that lets tests look into its device."""

    pair_budget: int
    """most pairs of splats and tiles that are listed at once; tests make it small"""

    def probe(self) -> Probe:
        """What looks into it."""
        ...


@runtime_checkable
class Reshapes(Backend, Protocol):
    """A backend whose build constants (its "shape") tests may replace: sizes of tiles, ways of sorting."""

    shape: Any
    """the device's own"""

    def shapes(self, kind: str) -> dict[str, Any]:
        """Build constants by a name that people read. kind: `tiles`, of other sizes, whose pictures have the
        same bits; `schedule`, the way in which a GPU walks its tiles (on a GPU: other tiles), whose pictures
        agree but for rounding; `listing`, the ways of listing splats per tile, under the schedule of a GPU
        where the device has several; `sorting`, the device's own and others for listing and sorting;
        `arithmetic`, the ways of compiling the functions of `Probe.arithmetic`, fused or not, in vectors or
        one by one, the device's own among them; `k_buffer`, smaller k-buffers, whose images are
        bit-identical; `tape`, fewer fragments that are kept for the way back, if the
        device keeps any, whose derivatives have the same bits."""
        ...

    def pieces(self, shape: Any) -> int:
        """In how many pieces the sorts cut what they sort."""
        ...

    def pipeline(self, features: FeatureSet, shape: Any = None) -> Pipeline:
        """As `Backend.pipeline`, with build constants of `shapes`."""
        ...
