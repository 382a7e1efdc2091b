"""The report: every table and figure that the results of a folder allow, in Markdown and HTML."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from fidsplat.errors import InputError
from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.document import Document
from fidsplat.experiments.pictures import sheet_files
from fidsplat.experiments.records import read_lines
from fidsplat.experiments.report_angles import Angles, report_angles
from fidsplat.experiments.report_counts import Counts, report_counts
from fidsplat.experiments.report_localisation import report_localisation
from fidsplat.experiments.report_views import Views, report_views
from fidsplat.experiments.targets import report_targets
from fidsplat.files import atomic_write, writable_folder

_COMMANDS = "fidsplat experiment {}"


def make_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write a report as Markdown and HTML with its plots and sheets; returns the files, the Markdown first.

    Args:
        folders: where results lie (`NAME.jsonl`, and sheets in the first that has any; else those
            that lie beside the plots stay).
        out: a folder for report.md and all that belongs to it; or a name that ends in .md, and the pictures
            go into a folder of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    lines = {
        name: [line for folder in folders for line in read_lines(folder / f"{name}.jsonl")]
        for name in (counts.NAME, angles.NAME, views.NAME, localisation.NAME)
    }
    if not any(lines.values()):
        raise InputError(
            f"no results in {', '.join(map(str, folders))}; run fidsplat experiment all first, or give their "
            "folder"
        )
    page = out if out.suffix == ".md" else out / "report.md"
    pictures = out.with_suffix("") if out.suffix == ".md" else out
    writable_folder(pictures)
    document = Document("Results of the paper's experiments")
    try:
        charts = _tables(document, lines)
    except KeyError as error:
        raise InputError(
            f"results in {', '.join(map(str, folders))} are of another version of fidsplat, they lack "
            f"{error}; measure again with --anew"
        ) from error
    sheets = next((found for folder in (*folders, pictures) if (found := sheet_files(folder))), [])
    if sheets:
        document.heading("Pictures")
        document.text("The middle 160 x 160 pixels of 800 x 800, marker 0 of each category.")
    for sheet in sheets:
        document.picture(sheet.name, sheet.stem)
        if sheet.parent.resolve() != pictures.resolve():
            with atomic_write(pictures / sheet.name) as stream, open(sheet, "rb") as source:
                shutil.copyfileobj(source, stream)
    before = "" if pictures == page.parent else f"{pictures.name}/"
    texts = {page: document.markdown(before), page.with_suffix(".html"): document.html(before)}
    texts |= {pictures / name: chart for name, chart in charts.items()}
    for file, text in texts.items():
        with atomic_write(file) as stream:
            stream.write(text.encode())
    return list(texts)


def _tables(document: Document, lines: dict[str, list[dict]]) -> dict[str, str]:
    """Add every table; returns charts, file name -> SVG."""
    _provenance(document, lines)
    report_targets(
        document,
        Angles(lines[angles.NAME]) if lines[angles.NAME] else None,
        Views(lines[views.NAME]) if lines[views.NAME] else None,
        Counts(lines[counts.NAME]) if lines[counts.NAME] else None,
    )
    charts: dict[str, str] = {}
    for name, report in (
        (counts.NAME, report_counts),
        (angles.NAME, report_angles),
        (views.NAME, report_views),
        (localisation.NAME, report_localisation),
    ):
        if lines[name]:
            charts |= report(document, lines[name])
        else:
            document.text(f"Nothing was measured by `{_COMMANDS.format(name)}`.")
    return charts


def _provenance(document: Document, lines: dict[str, list[dict]]) -> None:
    """What made the numbers: one line for each experiment and set of circumstances."""
    rows = []
    for name, found in lines.items():
        runs: dict[str, tuple[dict, int]] = {}
        for line in found:
            key = json.dumps(line["run"], sort_keys=True)
            runs[key] = line["run"], runs.get(key, (None, 0))[1] + 1
        for run, count in runs.values():
            versions = ", ".join(f"{package} {number}" for package, number in run["versions"].items())
            rows.append(
                (
                    f"{_COMMANDS.format(name)}",
                    str(count),
                    run["device"] or "nothing drawn",
                    run["machine"],
                    versions,
                    f"{run['commit']} / {run['code']}",
                    str(run["seed"]),
                    run["date"],
                )
            )
    heads = ("command", "parts", "device", "machine", "versions", "commit / code", "seed", "date")
    document.heading("Where the numbers come from")
    document.table(heads, rows)
