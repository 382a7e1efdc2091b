"""Numbers for tables: means with their spread."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence

from fidsplat.experiments.charts import Bar
from fidsplat.experiments.methods import FILTERS, IDEAL, mixtures, with_linear_light
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS

NOTHING = "-"


def mean_spread(values: Iterable[float | None], digits: int, never: bool = False) -> str:
    """Mean ± standard deviation of what there is; with ``never``, how many are None."""
    every = list(values)
    there = [value for value in every if value is not None]
    missing = len(every) - len(there)
    words = f" ({missing} of {len(every)} never)" if never and missing and there else ""
    if not there:
        return "never" if never and every else NOTHING
    spread = f" ± {statistics.stdev(there):.{digits}f}" if len(there) > 1 else ""
    return f"{statistics.fmean(there):.{digits}f}{spread}{words}"


def bar(values: Iterable[float | None]) -> Bar | None:
    """A bar of their mean, its error bar one standard deviation; None where there is nothing."""
    there = [value for value in values if value is not None]
    if not there:
        return None
    return Bar(statistics.fmean(there), statistics.stdev(there) if len(there) > 1 else 0.0)


def category_order(names: Iterable[str]) -> list[str]:
    """Those that occur, in the paper's order."""
    there = set(names)
    return [name for name in CATEGORIES if name in there]


def method_order(names: Iterable[str]) -> list[str]:
    """Those that occur: the ideal, mixtures, trained models."""
    there = set(names)
    own = with_linear_light(f"{m}/{filtered}" for m in mixtures() for filtered in FILTERS)
    known = [IDEAL, *own, *(f"2dgs-{n}" for n in COLLECTIONS)]
    return [name for name in known if name in there] + sorted(there - set(known))


def full_or_quick(lines: Sequence[dict], size) -> dict[tuple, dict]:
    """Of lines about the same thing the one that took the most measurements.

    size: line -> (what it is about, how much was measured).
    """
    best: dict[tuple, tuple[float, dict]] = {}
    for line in lines:
        about, amount = size(line)
        if about not in best or amount > best[about][0]:
            best[about] = amount, line
    return {about: line for about, (_, line) in best.items()}
