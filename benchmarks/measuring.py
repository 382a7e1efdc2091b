"""Functions of the measuring scripts: options, device facts, files and tables."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from datetime import date

from rich.console import Console
from rich.table import Table

import fidsplat as fs
from fidsplat.util.files import atomic_write

PROGRESS = Console(stderr=True)
"""console of progress messages, so that stdout has only figures"""


def options(about: str | None, device: str = "opencl", repeats: int | None = None) -> argparse.ArgumentParser:
    """Parser with --device and --json, and with --repeats if its default is given."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default=device, help=f"see `fidsplat devices` (default: {device})")
    if repeats is not None:
        parser.add_argument("--repeats", type=int, default=repeats, help=f"what counts (default: {repeats})")
    parser.add_argument("--json", metavar="FILE", help="write the figures; - for stdout only")
    return parser


def facts(renderer: fs.Renderer) -> dict[str, str]:
    """Device, versions and date of a measurement."""
    device = renderer.device
    return {
        "device": f"{device.title} ({device.platform})",
        "driver": device.version,
        "date": date.today().isoformat(),
        "fidsplat": fs.__version__,
    }


def keep(figures: object, file: str | None) -> bool:
    """Write records to a JSON file, if one is given. Returns whether the file is stdout."""
    text = json.dumps(figures, indent=1) + "\n"
    if file == "-":
        print(text, end="")
    elif file is not None:
        with atomic_write(file) as stream:
            stream.write(text.encode())
    return file == "-"


def show(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table, the first column left-aligned, numbers right-aligned."""
    table = Table(title=title, title_justify="left")
    for number, head in enumerate(heads):
        table.add_column(head, justify="right" if number else "left")
    for row in rows:
        table.add_row(*row)
    console = Console()
    console.width = max(console.width, 140)  # no line breaks in numbers
    console.print(table)
