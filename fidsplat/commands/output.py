"""Printing and progress of commands. With --json, stdout has one JSON object and stderr everything else."""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

from fidsplat.util import interrupts

if TYPE_CHECKING:
    from rich.console import Console

    from fidsplat.experiments.sweep import Key, Record, Sweep

T = TypeVar("T")
_MAX_WIDTH = 10_000
"""maximum width of a table in a file or pipe, characters"""
Table = tuple[str, Sequence[str], Iterable[Sequence[object]]]
"""title, column heads and rows, the arguments of `print_table`"""


def console(as_json: bool) -> Console:
    """The console for tables and progress: stdout, or stderr with --json."""
    from rich.console import Console

    return Console(stderr=as_json, highlight=False)


def report(as_json: bool, facts: dict[str, Any], *lines: str, table: Table | None = None) -> int:
    """Print the result of a command, as JSON or as a table and lines; returns the exit status 0."""
    if as_json:
        print_json(facts)
        return 0
    if table is not None:
        print_table(console(False), *table)
    print_lines(console(False), *lines)
    return 0


def print_json(value: dict[str, Any]) -> None:
    sys.stdout.write(json_text(value) + "\n")


def json_text(value: dict[str, Any]) -> str:
    """An object as JSON; infinities and NaN become null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False)


def print_lines(where: Console, *lines: str) -> None:
    """Print lines without markup and without line breaks."""
    for line in lines:
        where.print(line, markup=False, soft_wrap=True)


def print_table(where: Console, title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table under its title; cells are plain text, and wrap in a terminal only."""
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(
        title=Text(title, "bold"),
        title_justify="left",
        show_header=any(heads),
        header_style="underline",
        box=None,
        padding=(0, 2, 0, 0),
    )
    for head in heads:
        table.add_column(Text(head), overflow="fold")
    for row in rows:
        table.add_row(*(Text(str(cell)) for cell in row))
    if not where.is_terminal:
        natural = where.measure(table, options=where.options.update(max_width=_MAX_WIDTH)).maximum
        where.width = max(where.width, natural)
    where.print(table)


def progress_bar(where: Console, *columns: Any) -> Any:
    """Progress bar that disappears at its end; for files and pipes, a line on stderr every 30 s."""
    if not where.is_interactive:
        from fidsplat.commands.progress_lines import ProgressLines

        return ProgressLines()
    from rich.progress import Progress

    return Progress(*columns, console=where, transient=True)


@contextmanager
def steps_shown(where: Console, first: str) -> Iterator[Callable[[str], None]]:
    """Progress callback that shows the current step of work of unknown length."""
    from rich.progress import SpinnerColumn, TextColumn

    with progress_bar(where, SpinnerColumn(), TextColumn("{task.description}")) as bar:
        task = bar.add_task(first, total=None)
        yield lambda step: bar.update(task, description=step)


@contextmanager
def delayed_progress(after: float = 1.0) -> Iterator[Callable[[str, float], None]]:
    """Progress callback (description, completed fraction) whose bar appears on stderr after some seconds.

    A timer thread shows the bar, so that it also appears during long work between two calls.
    """
    bar = progress_bar(console(True))
    task = bar.add_task("", total=1.0)
    timer = threading.Timer(after, bar.start)
    timer.daemon = True
    timer.start()

    def progress(description: str, fraction: float) -> None:
        interrupts.check()
        bar.update(task, description=description, completed=fraction)

    try:
        yield progress
    finally:
        timer.cancel()
        timer.join()
        bar.stop()


def show_progress(
    name: str,
    steps: Iterable[T],
    total: int | None,
    done: int = 0,
    label: Callable[[T], str] = lambda step: "",
) -> Iterator[T]:
    """Yield each finished step; a progress bar on stderr counts the steps and shows the last one's label."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with progress_bar(console(True), *columns) as bars:
        bar = bars.add_task(name, total=total, completed=done)
        for step in steps:
            interrupts.check()
            bars.update(bar, advance=1, description=f"{name} {label(step)}".strip())
            yield step


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):  # also NumPy's float64
        return float(value) if math.isfinite(value) else None
    to_list = getattr(value, "tolist", None)  # NumPy's other numbers and arrays
    return value if to_list is None else _plain(to_list())


def run_sweeps(sweeps: Iterable[Sweep]) -> list[Record]:
    """Measure the missing points of the sweeps, one sweep after the other; returns their records."""
    records = []
    for sweep in sweeps:
        total, left = len(sweep.points), len(sweep.left)
        records += show_progress(sweep.name, sweep.run(), total, total - left, lambda r: point_label(r.key))
    return records


def point_label(key: Key) -> str:
    """Label of a point: the strings of its key, without numbers and settings."""
    return " ".join(value for value in key.values() if isinstance(value, str))
