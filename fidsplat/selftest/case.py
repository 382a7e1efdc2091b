"""A hard case: a name of the catalogue (numerics.md, A1 to G5), its trigger, and pictures and numbers that
must hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from fidsplat.render.renderer import Renderer
from fidsplat.selftest.agreement import FrameSpec


@dataclass(frozen=True)
class Finding:
    """One number that a case measured, and what it may be at most."""

    what: str
    value: float
    bound: float

    @property
    def holds(self) -> bool:
        """False for a NaN too."""
        return self.value <= self.bound


Found = Iterator[FrameSpec | Finding]


@dataclass(frozen=True)
class Case:
    """One entry of the catalogue. It holds if all its pictures agree with the reference and all its findings
    hold.
    """

    name: str
    """e.g. "A1"; the letter is the group"""
    title: str
    trigger: str
    """the values that bring it about, in words"""
    run: Callable[[Renderer], Found]
    """pictures to compare with the reference, and properties that are no picture: invariances, counts,
    monotony"""


CASES: list[Case] = []
"""those of the modules that have been imported; `catalogue` imports all"""


def case(name: str, title: str, trigger: str) -> Callable[[Callable[[Renderer], Found]], Callable]:
    """Enters a function into the catalogue."""

    def enter(run: Callable[[Renderer], Found]) -> Callable[[Renderer], Found]:
        CASES.append(Case(name, title, trigger, run))
        return run

    return enter
