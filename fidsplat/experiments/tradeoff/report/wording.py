"""Numbers in tables."""

from __future__ import annotations

from fidsplat.experiments.figures import NOTHING


def number(value: float | None, digits: int = 2) -> str:
    """A number to some significant digits."""
    return NOTHING if value is None else f"{value:.{digits}g}"


def fixed(value: float | None, digits: int = 1) -> str:
    """A number to some digits behind the point."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(ratio: float | None) -> str:
    """A ratio of times as what it adds: +12 %."""
    if ratio is None:
        return NOTHING
    added = 100 * (ratio - 1)
    return f"{added:+.1f} %" if abs(added) < 10 else f"{added:+.0f} %"


def listed(words: list[str]) -> str:
    """Settings in a sentence, whose names may have commas; nothing is "none"."""
    return "; ".join(words) if words else "none"
