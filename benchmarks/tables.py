"""Markdown tables of the pages, and fits of power laws. Imports no numerical package, since mkdocs imports
it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from statistics import linear_regression


def exponent(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Exponent p of a least-squares fit y = c x^p to the upper half of the points, where constant costs are
    negligible (to all of them if there are at most three); None for fewer than two different x."""
    pairs = [(math.log(a), math.log(b)) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    upper = pairs[len(pairs) // 2 :] if len(pairs) > 3 else pairs
    if len({a for a, _ in upper}) < 2:
        return None
    return linear_regression(*zip(*upper, strict=True)).slope


def markdown(rows: Iterable[dict[str, str]]) -> str:
    """Markdown table of rows {column: cell}; a dash for a missing cell."""
    rows = list(rows)
    if not rows:
        return ""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    cells = [columns, ["---"] * len(columns), *([row.get(column, "-") for column in columns] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells).replace(" --- ", "---")


def insert(page: str, name: str, text: str) -> str:
    """Replace the text between the marks of a name, if the page has them."""
    marks = re.compile(rf"(<!-- begin {name} -->\n).*?(<!-- end {name} -->)", re.DOTALL)
    return marks.sub(lambda match: f"{match[1]}{text}\n{match[2]}", page)


def ms(value: float) -> str:
    """Format milliseconds with three significant digits."""
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
