"""Sweeps on the command line: progress while they run, and the results kept when they are stopped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import console, option, switch
from fidsplat.errors import InputError

if TYPE_CHECKING:
    from rich.progress import Progress

    from fidsplat.experiments.sweep import Key, Record, Sweep

Names = tyro.conf.UseAppendAction[tuple[str, ...]]
"""an option that may be given several times"""
Folders = tyro.conf.Positional[tuple[str, ...]]
Seed = Annotated[int, option("N", "of texts and views (default: 0)")]
Overwrite = Annotated[bool, switch("measure again what is in the results' folder")]
ReportTo = Annotated[
    str | None, option("DIR|FILE.md", "folder or file for the report (default: the first folder)", "-o")
]


def need_reports() -> None:
    """Raises InputError where what makes reports is not installed."""
    missing = [name for name in ("pandas", "matplotlib", "jinja2") if find_spec(name) is None]
    if missing:
        raise InputError(f"reports need {' and '.join(missing)}; pip install 'fidsplat[experiments]'")


def run_sweeps(sweeps: Iterable[Sweep]) -> list[Record]:
    """Measure what is left of each, with a progress bar on stderr; returns what was measured."""
    found = []
    for sweep in sweeps:
        with bars() as progress:
            total = len(sweep.points)
            bar = progress.add_task(sweep.name, total=total, completed=total - len(sweep.left))
            for record in sweep.run():
                progress.update(bar, advance=1, description=f"{sweep.name} {words(record.key)}")
                found.append(record)
            progress.update(bar, description=sweep.name)
    return found


def run_in_turn(name: str, sweeps: Sequence[Sweep]) -> list[Record]:
    """As `run_sweeps`, the first point of each before the second of any, with one progress bar."""
    from fidsplat.experiments.sweep import in_turn

    found = []
    with bars() as progress:
        total, left = sum(len(sweep.points) for sweep in sweeps), sum(len(sweep.left) for sweep in sweeps)
        bar = progress.add_task(name, total=total, completed=total - left)
        for record in in_turn(sweeps):
            progress.update(bar, advance=1, description=f"{name} {words(record.key)}")
            found.append(record)
        progress.update(bar, description=name)
    return found


def bars() -> Progress:
    """Progress by points, on stderr."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    return Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console(True))


def words(key: Key) -> str:
    """A point in words: its names, without numbers and settings."""
    return " ".join(value for value in key.values() if isinstance(value, str))
