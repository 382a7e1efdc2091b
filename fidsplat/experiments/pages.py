"""Pages of results: Markdown from a template beside this file and tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup

from fidsplat.experiments.summary import Frame
from fidsplat.util.files import atomic_write, printable, writable_folder
from fidsplat.util.markup import escaped

NOTHING = "-"
BEGIN, END = "<!-- begin generated -->", "<!-- end generated -->"
"""lines around the generated block of a page that is otherwise written by hand"""


def places(out: Path, name: str = "report.md") -> tuple[Path, Path]:
    """The page and the folder of its charts and tables: for a folder both in it, for a name that ends in .md
    a folder of that name without .md. Raises InputError when that cannot be written."""
    if out.suffix == ".md":
        return out, writable_folder(out.with_suffix(""))
    return writable_folder(out) / name, out


def write_page(page: Path, folder: Path, template: str, context: Mapping[str, Any]) -> None:
    """Fill a template and write the page.

    Args:
        folder: of charts; the template has its name, relative to the page, as `folder`.
        context: what the template needs; pandas tables are filtered by `table`. Text is escaped, as names of
            data sets and files may hold HTML; Markdown of our own is a `Markup`.
    """
    _write(page, _filled(page, folder, template, context))


def has_block(page: Path) -> bool:
    """Whether a page exists and has a generated block."""
    return page.is_file() and BEGIN in page.read_text("utf-8").splitlines()


def write_block(page: Path, folder: Path, template: str, context: Mapping[str, Any]) -> None:
    """Replace the generated block of a page. Arguments: as `write_page`."""
    before, _, rest = page.read_text("utf-8").partition(f"{BEGIN}\n")
    _, _, after = rest.partition(f"{END}\n")
    block = _filled(page, folder, template, context)
    _write(page, f"{before}{BEGIN}\n{block}{END}\n{after}")


def _write(page: Path, text: str) -> None:
    with atomic_write(page) as stream:
        stream.write(printable(text).encode())


def _filled(page: Path, folder: Path, template: str, context: Mapping[str, Any]) -> str:
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).with_name("templates")),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_inserted,
    )
    environment.filters |= {"table": markdown_table, "number": number, "percent": percent, "listed": listed}
    beside = "" if folder == page.parent else f"{folder.name}/"
    return environment.get_template(template).render(**context, folder=beside)


def markdown_table(frame: Frame) -> Markup:
    """A table; its first column is text, the others stand at the right."""
    rows = [frame.columns, ["---", *["---:"] * (len(frame.columns) - 1)], *frame.itertuples(index=False)]
    return Markup("\n".join("| " + " | ".join(_cell(cell) for cell in row) + " |" for row in rows))


def number(value: float | None, digits: int = 2) -> str:
    """A number to some significant digits."""
    return NOTHING if value is None or pd.isna(value) else f"{value:.{digits}g}"


def fixed(value: float | None, digits: int = 1) -> str:
    """A number to some digits behind the point."""
    return NOTHING if value is None or pd.isna(value) else f"{value:.{digits}f}"


def percent(ratio: float | None) -> str:
    """A ratio of times as what it adds: +12 %."""
    if ratio is None or pd.isna(ratio):
        return NOTHING
    added = 100 * (ratio - 1)
    return f"{added:+.1f} %" if abs(added) < 10 else f"{added:+.0f} %"


def listed(words: list[str]) -> str:
    """Things in a sentence, whose names may have commas; nothing is "none"."""
    return "; ".join(words) if words else "none"


def _cell(value: object) -> str:
    return NOTHING if value is None else _inserted(value)


def _inserted(value: object) -> str:
    return str(value) if isinstance(value, Markup) else escaped(value)
