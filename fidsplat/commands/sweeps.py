"""Sweeps on the command line: progress while they run, and the results kept when they are stopped."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import counted, option, writable_file
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.sweep import Key, Record, Sweep

Folders = tyro.conf.Positional[tuple[str, ...]]
BlenderEnvironment = Annotated[
    Path | None,
    option("DIR", "Blender's virtual environment (default: fidsplat/blender in the user's cache)"),
]
ReportTo = Annotated[
    str | None, option("DIR|FILE.md", "folder or file for the report (default: the first folder)", "-o")
]


def need_reports(
    what: str = "a report", packages: Sequence[str] = ("pandas", "matplotlib", "jinja2")
) -> None:
    """Raises InputError where what makes it is not installed."""
    missing = [name for name in packages if find_spec(name) is None]
    if missing:
        raise InputError(f"{what} needs {' and '.join(missing)}; pip install 'fidsplat[experiments]'")


def check_plot(name: str, *packages: str) -> None:
    """Raises InputError for a chart that cannot be written, before anything is measured; packages: what it
    needs besides matplotlib."""
    if Path(name).suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--plot is {name}; charts are written as SVG or PNG: name a file that ends so")
    need_reports("--plot", ("matplotlib", *packages))
    writable_file(name)


def run_sweeps(sweeps: Iterable[Sweep]) -> list[Record]:
    """Measure what is left of each, with a progress bar on stderr; returns what was measured."""
    return [record for sweep in sweeps for record in _counted(sweep.name, [sweep], sweep.run())]


def run_in_turn(name: str, sweeps: Sequence[Sweep]) -> list[Record]:
    """As `run_sweeps`, the first point of each before the second of any, with one progress bar."""
    from fidsplat.experiments.sweep import in_turn

    return list(_counted(name, sweeps, in_turn(sweeps)))


def _counted(name: str, sweeps: Sequence[Sweep], records: Iterable[Record]) -> Iterator[Record]:
    total, left = sum(len(sweep.points) for sweep in sweeps), sum(len(sweep.left) for sweep in sweeps)
    return counted(name, records, total, total - left, lambda record: words(record.key))


def words(key: Key) -> str:
    """A point in words: its names, without numbers and settings."""
    return " ".join(value for value in key.values() if isinstance(value, str))
