"""Roofline model of a frame: minimum bytes and operations of each stage.

devlog/roofline.md derives the numbers. They describe the method (2D splats, exact intersection, float32), not
the kernels: data is read once, and only composited fragments are counted.
"""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.backends.interface import Rates

# bytes read per splat: position, scales and opacity for culling; rotation and colour if visible
_CULLING, _ROTATION, _COLOR = 12 + 8 + 4, 16, 12
RECORD = 64  # bytes of intersection and colour of a splat, as in splat.cl
WINDOW = 8  # bytes of the tile range of a splat
_KEY, _INDEX = 4, 4
# operations that a multiply-add unit executes once per cycle
_CULLING_FMA, _PROJECTION_FMA, _PROJECTION_DIVISIONS = 20, 160, 4
FRAGMENT_FMA = 30  # exp and division are counted separately


@dataclass(frozen=True)
class Counts:
    """Numbers of splats, pixels and fragments of a frame."""

    splats: int
    visible: int
    pairs: int
    """pairs of splats and tiles"""
    fragments: int
    """composited fragments"""
    pixels: int
    sh_coefficients: int = 0
    """SH coefficients per channel above degree 0; 0 for plain colours"""


@dataclass(frozen=True)
class Work:
    """Minimum work of a stage of a frame."""

    bytes: float = 0.0
    """bytes read and written"""
    fma: float = 0.0
    exp: float = 0.0
    division: float = 0.0

    def ms(self, rates: Rates) -> float:
        """Minimum time in ms: memory and arithmetic overlap; all arithmetic shares the same units."""
        memory = self.bytes / rates.copy_bytes
        arithmetic = self.fma / rates.fma + self.exp / rates.exp + self.division / rates.division
        return 1e3 * max(memory, arithmetic)


def roofline_work(counts: Counts) -> dict[str, Work]:
    """Minimum work by stage, in the order of the stages."""
    n, visible, colors = counts.splats, counts.visible, 1 + counts.sh_coefficients
    return {
        "project": Work(
            bytes=n * _CULLING + visible * (_ROTATION + _COLOR * colors + RECORD + WINDOW + _KEY),
            fma=n * _CULLING_FMA + visible * (_PROJECTION_FMA + 3 * counts.sh_coefficients),
            division=visible * _PROJECTION_DIVISIONS,
        ),
        "sort": Work(bytes=visible * (_KEY + _INDEX)),
        "bin": Work(bytes=visible * (_INDEX + WINDOW) + counts.pairs * _INDEX),
        "blend": Work(
            bytes=counts.pairs * _INDEX + visible * RECORD,
            fma=counts.fragments * FRAGMENT_FMA,
            exp=counts.fragments,
            division=counts.fragments,
        ),
        "resolve": Work(bytes=counts.pixels * 12),
    }


def roofline_ms(counts: Counts, rates: Rates) -> dict[str, float]:
    """Roofline by stage in milliseconds, for the rates of a device."""
    return {stage: work.ms(rates) for stage, work in roofline_work(counts).items()}
