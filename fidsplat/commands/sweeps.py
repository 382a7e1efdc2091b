"""Sweeps on the command line: progress while they run, and the results kept when they are stopped."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import console, option, switch
from fidsplat.errors import InputError

if TYPE_CHECKING:
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
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    found = []
    for sweep in sweeps:
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
        with Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console(True)
        ) as progress:
            total = len(sweep.points)
            bar = progress.add_task(sweep.name, total=total, completed=total - len(sweep.left))
            for record in sweep.run():
                progress.update(bar, advance=1, description=f"{sweep.name} {words(record.key)}")
                found.append(record)
            progress.update(bar, description=sweep.name)
    return found


def words(key: Key) -> str:
    """A point in words: its names, without numbers and settings."""
    return " ".join(value for value in key.values() if isinstance(value, str))
