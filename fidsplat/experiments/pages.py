"""Reports in Markdown from a template and tables."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd
from markupsafe import Markup

from fidsplat.experiments.summary import Table
from fidsplat.util.errors import InputError
from fidsplat.util.files import printable, read_text, writable_folder, write_file
from fidsplat.util.markup import escaped

NOTHING = "-"
TEMPLATES = Path(__file__).with_name("templates")


def page_and_folder(out: Path, template: str) -> tuple[Path, Path]:
    """File of a report, and folder of its charts and tables.

    For a folder, report.md in it; for a name that ends in .md, this file and a folder of that name without
    .md. Raises InputError if the folder cannot be written, or the file is not a report of this template.
    """
    if out.suffix != ".md":
        return writable_folder(out) / "report.md", out
    title = read_text(TEMPLATES / template).splitlines()[0].partition("{{")[0]
    if out.exists() and not read_text(out).startswith(title):
        raise InputError(
            f"-o must be a new file or an earlier report, got {out}, which does not start with {title!r}; "
            "give another name"
        )
    return out, writable_folder(out.with_suffix(""))


def write_page(page: Path, folder: Path, template: str, context: Mapping[str, Any]) -> None:
    """Fill a template and write the report; arguments as of `fill_template`."""
    write_file(page, printable(fill_template(page, folder, template, context)))


def fill_template(
    page: Path, folder: Path, template: str, context: Mapping[str, Any], templates: Path = TEMPLATES
) -> str:
    """Fill a template and return its text.

    Args:
        page: file of the text.
        folder: folder of charts; its path relative to the page is the variable `folder`.
        context: variables of the template; the filter `table` formats pandas tables. Text that is not a
            `Markup` is escaped, since names of data sets and files may contain HTML.
        templates: folder of the template.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(templates),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_inserted,
    )
    environment.filters |= {"table": markdown_table, "number": number, "listed": listed}
    prefix = os.path.relpath(folder, page.parent).replace(os.sep, "/") + "/"
    prefix = "" if prefix == "./" else prefix
    return environment.get_template(template).render(**context, folder=prefix)


def markdown_table(frame: Table) -> Markup:
    """Format a table as Markdown, with all columns right-aligned except the first."""
    rows = [frame.columns, ["---", *["---:"] * (len(frame.columns) - 1)], *frame.itertuples(index=False)]
    return Markup("\n".join("| " + " | ".join(map(_cell, row)) + " |" for row in rows))


def number(value: float | None, digits: int = 2) -> str:
    """Format a number with some significant digits."""
    return NOTHING if value is None or pd.isna(value) else f"{value:.{digits}g}"


def fixed(value: float | None, digits: int = 1) -> str:
    """Format a number with some decimal places."""
    return NOTHING if value is None or pd.isna(value) else f"{value:.{digits}f}"


def percent(ratio: float | None) -> str:
    """Format a ratio as a relative change from 1, such as +12 %."""
    if ratio is None or pd.isna(ratio):
        return NOTHING
    change = 100 * (ratio - 1)
    return f"{change:+.1f} %" if abs(change) < 10 else f"{change:+.0f} %"


def listed(names: list[str]) -> str:
    """Join names, which may contain commas, for a sentence; "none" if there are none."""
    return "; ".join(names) if names else "none"


def _cell(value: object) -> str:
    return NOTHING if value is None else _inserted(value)


def _inserted(value: object) -> str:
    return str(value) if isinstance(value, Markup) else escaped(value)
