"""Definition of a hard case (docs/correctness.md): frames to compare, and measured numbers with bounds."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from fidsplat.render.renderer import Renderer
from fidsplat.selftest.agreement import FrameSpec


@dataclass(frozen=True)
class Finding:
    """A measured number and its upper bound."""

    what: str
    value: float
    bound: float

    @property
    def holds(self) -> bool:
        """Whether the number is within its bound; false for NaN."""
        return self.value <= self.bound


Found = Iterator[FrameSpec | Finding]


@dataclass(frozen=True)
class Case:
    """A hard case. It passes if all its frames agree with the reference and all its findings hold."""

    name: str
    """e.g. "A1"; the letter is the group"""
    title: str
    trigger: str
    """input values that make it hard"""
    run: Callable[[Renderer], Found]
    """yields frames to compare with the reference, and findings: invariances, counts, jumps"""


CASES: list[Case] = []
"""cases of all imported modules; `catalogue` imports all modules"""


def case(name: str, title: str, trigger: str) -> Callable[[Callable[[Renderer], Found]], Callable]:
    """Decorator that registers a function as a hard case.

    Args:
        name, title, trigger: fields of `Case`.
    """

    def register(run: Callable[[Renderer], Found]) -> Callable[[Renderer], Found]:
        CASES.append(Case(name, title, trigger, run))
        return run

    return register
