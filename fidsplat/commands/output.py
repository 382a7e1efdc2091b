"""What commands print: with --json one object on stdout and all else on stderr."""

from __future__ import annotations

import json
import math
import re
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, Union, get_args, get_origin

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import ordinary_file, path_of, writable_folder

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")
Table = tuple[str, Sequence[str], Iterable[Sequence[object]]]
"""title, heads and rows, as of `print_table`"""


repeatable = tyro.conf.configure(tyro.conf.UseAppendAction)
"""Decorator of a command whose options of several values are repeated, one value each."""


def option(metavar: str, text: str, short: str | None = None):
    """tyro's description of an argument; its text says the default itself."""
    aliases = [] if short is None else [short]
    return tyro.conf.arg(metavar=metavar, help=text, aliases=aliases, help_behavior_hint="")


Device = Annotated[str | None, option("D", "see `fidsplat devices` (default: FIDSPLAT_DEVICE, or auto)")]

Devices = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    option("D", "see `fidsplat devices`; once more for each (default: FIDSPLAT_DEVICE, or auto)"),
]

SceneDevice = Annotated[
    str | None, option("D", "see `fidsplat devices` (default: the scene's, or FIDSPLAT_DEVICE, or auto)")
]
SceneOutputs = Annotated[
    str | None, option("A,B,...", "outputs, as for `fidsplat render` (default: the scene's, or rgb)")
]
SceneQuality = Annotated[
    str | None, option("Q", "as for `fidsplat render` (default: the scene's, or standard)")
]
"""of commands that draw a scene, which may say these itself"""


def names_of(text: str | None) -> tuple[str, ...] | None:
    """Names with commas between, as of --outputs; None where nothing is given."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def check_words(outputs: tuple[str, ...] | None, quality: str | None) -> None:
    """Raises InputError for outputs or a quality that no scene could have, before anything is opened."""
    import fidsplat as fs
    from fidsplat.effects import select

    select(fs.SplatCloud.empty(), fs.Capture(outputs=outputs or "rgb", quality=fs.Quality.of(quality)))


MemoryBudget = Annotated[
    str | None,
    option("SIZE", "of the device, for a picture and its splats, e.g. 2GiB (default: nine tenths of it)"),
]


optional_values = ConstructorRegistry()
"""tyro's rules for values, with one for options that may be left out: their help names the type alone."""


@optional_values.primitive_rule
def _optional_value(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
    if get_origin(info.type) not in (Union, UnionType) or len(kinds) != 1:
        return None
    of = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
    if not isinstance(of, PrimitiveConstructorSpec):
        return None
    return replace(
        of,
        is_instance=lambda value: value is None or of.is_instance(value),
        str_from_instance=lambda value: ["none"] if value is None else of.str_from_instance(value),
    )


def switch(text: str):
    """tyro's description of an option that is given or not."""
    return tyro.conf.arg(help=text, help_behavior_hint="")


Overwrite = Annotated[bool, switch("replace what is there already")]
"""of commands that write what may be somebody's own, or hours of work; pictures, charts and tables take the
place of those before"""

Json = Annotated[bool, switch("print one JSON object on stdout and nothing else there")]


def console(as_json: bool) -> Console:
    """Where tables and progress go."""
    from rich.console import Console

    return Console(stderr=as_json, highlight=False)


def print_json(value: dict[str, Any]) -> None:
    """The one object; a number that JSON does not have becomes null."""
    sys.stdout.write(json_text(value) + "\n")


def json_text(value: dict[str, Any]) -> str:
    """An object as JSON; a number that JSON does not have becomes null."""
    return json.dumps(_plain(value), indent=2, allow_nan=False)


def say(where: Console, *lines: str) -> None:
    """Print lines as they are: not as markup, and not broken."""
    for line in lines:
        where.print(line, markup=False, soft_wrap=True)


def tell(as_json: bool, facts: dict[str, Any], *lines: str, table: Table | None = None) -> int:
    """Print what a command found, as JSON or as a table and lines; returns the exit status 0."""
    if as_json:
        print_json(facts)
    else:
        if table is not None:
            print_table(console(False), *table)
        say(console(False), *lines)
    return 0


def print_table(where: Console, title: str, heads: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A table under its title; texts are taken as they are, not as markup, and broken rather than cut."""
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
    where.print(table)


def progress_bar(where: Console, *columns: Any) -> Any:
    """A bar that goes when it is done; none in a file or a pipe, where it would leave an empty line."""
    from rich.progress import Progress

    return Progress(*columns, console=where, transient=True, disable=not where.is_interactive)


@contextmanager
def late_progress(where: Console, after: float = 1.0) -> Iterator[Callable[[str, float], None]]:
    """What to call with words and the share that is done, 0 to 1; a bar shows it once that many seconds
    passed.

    Short work prints nothing, and long work between two calls is seen too: a thread watches the time.
    """
    shown = progress_bar(where)
    task = shown.add_task("", total=1.0)
    timer = threading.Timer(after, shown.start)
    timer.daemon = True
    timer.start()

    def show(words: str, share: float) -> None:
        interrupts.check()
        shown.update(task, description=words, completed=share)

    try:
        yield show
    finally:
        timer.cancel()
        timer.join()
        if shown.live.is_started:
            shown.stop()


def counted(
    name: str, steps: Iterable[T], total: int, done: int = 0, words: Callable[[T], str] = lambda step: ""
) -> Iterator[T]:
    """The steps, each once it is done, counted by a bar on stderr that says what the last was."""
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with progress_bar(console(True), *columns) as progress:
        bar = progress.add_task(name, total=total, completed=done)
        for step in steps:
            interrupts.check()
            progress.update(bar, advance=1, description=f"{name} {words(step)}".strip())
            yield step


_UNITS = {"": 1, "b": 1, "kb": 10**3, "mb": 10**6, "gb": 10**9, "kib": 2**10, "mib": 2**20, "gib": 2**30}


def bytes_of(option: str, text: str | None) -> int | None:
    """A number of bytes with or without a unit; None stays None. Raises InputError for anything else."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([a-z]*)\s*", text.lower())
    size = int(float(found[1]) * _UNITS.get(found[2], 0)) if found else 0
    if size <= 0:
        raise InputError(f"{option} is {text!r}; give a number of bytes above 0, e.g. 500MB or 2GiB")
    return size


def writable_file(path: str | Path) -> Path:
    """The path, after a proof that a file can be written beside it. Raises InputError."""
    file = path_of(path)
    if file.is_dir():
        raise InputError(f"{file} is a folder; give the name of a file")
    writable_folder(file.parent)
    return ordinary_file(file)


def new_file(path: str | Path, overwrite: bool) -> Path:
    """As `writable_file`, of a file that takes the place of another only where that is asked for."""
    file = writable_file(path)
    if file.exists() and not overwrite:
        raise InputError(f"{file} is there already; give another name, or --overwrite")
    return file


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float):  # NumPy's float64 is one of them
        return float(value) if math.isfinite(value) else None
    listed = getattr(value, "tolist", None)  # NumPy's numbers and arrays
    return value if listed is None else _plain(listed())
