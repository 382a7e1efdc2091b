"""A hard case: a name of the catalogue (numerics.md, A1 to F6), its trigger, and pictures or checks that must
hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from fidsplat.hard_cases.agreement import Picture
from fidsplat.render import Renderer


@dataclass(frozen=True)
class Finding:
    """One number that a check measured, and what it may be at most."""

    what: str
    value: float
    bound: float

    @property
    def holds(self) -> bool:
        """False for a NaN too."""
        return self.value <= self.bound


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
    pictures: Callable[[], Iterable[Picture]] | None = None
    check: Callable[[Renderer], Iterable[Finding]] | None = None
    """properties that are no picture against the reference: invariances, counts, monotony"""

    @property
    def group(self) -> str:
        """A to F."""
        return self.name[0]
