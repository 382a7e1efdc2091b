"""What a frame must at least cost: bytes and operations of each stage, counted from what there is to draw.

devlog/roofline.md derives the numbers. They are of the method (2D splats, exact crossing, float32), not of
our kernels: what one frame reads once is counted once, and of the fragments only those that are drawn.
"""

from __future__ import annotations

from dataclasses import dataclass

from fidsplat.backends.interface import Rates

# bytes of one splat: position, scales and opacity decide whether it is seen; rotation and colour are needed
# if it is
_DECIDE, _ROTATION, _COLOR = 12 + 8 + 4, 16, 12
RECORD = 64  # what the crossing and the colour of a splat take, as in splat.cl
WINDOW = 8  # what says which tiles a splat can touch
_KEY, _INDEX = 4, 4
# operations that a multiply-add unit can do one of per cycle
_DECIDE_FMA, _SET_UP_FMA, _SET_UP_DIVISIONS = 20, 160, 4
FRAGMENT_FMA = 30  # exp and division are counted apart


@dataclass(frozen=True)
class Counts:
    """What there is to draw."""

    splats: int
    visible: int
    pairs: int
    """of splats and tiles"""
    fragments: int
    """drawn: within the splat's reach, in front of the near plane, the pixel not finished"""
    pixels: int
    sh_coefficients: int = 0
    """of each colour channel, beside the constant one; 0 for plain colours"""


@dataclass(frozen=True)
class Work:
    """What a stage must do."""

    bytes: float = 0.0
    """read and written"""
    fma: float = 0.0
    exp: float = 0.0
    division: float = 0.0

    def ms(self, rates: Rates) -> float:
        """The least time for it: memory and arithmetic may overlap, kinds of arithmetic share their units."""
        memory = self.bytes / rates.copy_bytes
        arithmetic = self.fma / rates.fma + self.exp / rates.exp + self.division / rates.division
        return 1e3 * max(memory, arithmetic)


def roofline_work(counts: Counts) -> dict[str, Work]:
    """The least work by stage, in the order of the stages."""
    n, visible, colors = counts.splats, counts.visible, 1 + counts.sh_coefficients
    return {
        "project": Work(
            bytes=n * _DECIDE + visible * (_ROTATION + _COLOR * colors + RECORD + WINDOW + _KEY),
            fma=n * _DECIDE_FMA + visible * (_SET_UP_FMA + 3 * counts.sh_coefficients),
            division=visible * _SET_UP_DIVISIONS,
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
    """The least milliseconds by stage on a device of these rates."""
    return {stage: work.ms(rates) for stage, work in roofline_work(counts).items()}
