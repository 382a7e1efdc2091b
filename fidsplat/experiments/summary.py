"""Results as small CSV tables, which begin with lines that contain facts of the runs.

A table has a row per result, with the `amount` of its measurements and the index of its `run`. Lines that
begin with "# " contain facts of the runs, and notes.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import pandas as pd

from fidsplat.experiments.sweep import Record
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text, write_file

_MARK = "# "
Table: TypeAlias = Any
"""a `pandas.DataFrame` with cells of unknown type"""
Row: TypeAlias = Any
"""a `pandas.Series`"""


@dataclass(eq=False)
class Summary:
    """A table of results."""

    rows: Table
    runs: list[dict[str, Any]]
    """facts of each run (`fidsplat.util.provenance.run_facts`), and its number of measurements, `points`"""
    notes: list[str] = field(default_factory=list)
    """notes for readers of the table"""

    def write(self, file: Path) -> Summary:
        """Write the table with numbers rounded to four digits; returns the table as read from the file.

        Therefore reports of raw results and of summaries are equal.

        Raises InputError if the file cannot be written.
        """
        lines = [{"run": run} for run in self.runs] + [{"note": note} for note in self.notes]
        text = "".join(f"{_MARK}{json.dumps(line)}\n" for line in lines)
        text += self.rows.to_csv(index=False, float_format="%.4g", lineterminator="\n")
        write_file(file, text)
        return read_summary(file)


def summarise(
    records: Iterable[Record],
    rows_of: Callable[[Record], Iterable[dict[str, Any]]],
    columns: Iterable[str],
) -> Summary:
    """Table with the rows of all records."""
    runs: dict[str, dict[str, Any]] = {}
    rows = []
    for record in records:
        name = json.dumps(record.run, sort_keys=True)
        run = runs.setdefault(name, record.run | {"points": 0})
        run["points"] += 1
        number = list(runs).index(name)
        rows += [row | {"run": number} for row in rows_of(record)]
    return Summary(pd.DataFrame(rows, columns=[*columns, "run"]), list(runs.values()))


def read_summary(file: Path) -> Summary:
    """Read a file of `Summary.write`. Raises InputError for a file of another format."""
    try:
        lines = read_text(file).splitlines()
        facts = [from_json(line.removeprefix(_MARK)) for line in lines if line.startswith(_MARK)]
        if not all(isinstance(item, dict) for item in facts):
            raise ValueError("the lines before its table must be facts")
        if any("repeated" in item for item in facts):
            raise ValueError(
                "its format is of an earlier version; make the report again from the .jsonl files"
            )
        # only empty cells are missing values: "None" is a string
        table = io.StringIO("\n".join(lines[len(facts) :]))
        rows = pd.read_csv(table, keep_default_na=False, na_values=[""])
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {file}: {error}") from error
    runs = [item["run"] for item in facts if "run" in item]
    if "run" not in rows or not runs:
        raise InputError(
            f"{file} must be a summary that `fidsplat experiment` wrote, got another CSV file; "
            "give another folder"
        )
    return Summary(rows, runs, [item["note"] for item in facts if "note" in item])


def join(summaries: Sequence[Summary], keys: Sequence[str]) -> Summary:
    """Join tables of one kind. Among rows with equal keys, the first row with the largest `amount`
    remains."""
    frames, runs = [], []
    for summary in summaries:
        frames.append(summary.rows.assign(run=summary.rows["run"] + len(runs)))
        runs += summary.runs
    rows = pd.concat(frames, ignore_index=True)
    chosen = rows.sort_values("amount", ascending=False, kind="stable").drop_duplicates(list(keys))
    rows = rows.loc[sorted(chosen.index)].reset_index(drop=True)
    # when a report is made again, its own earlier tables may contribute no row
    used = sorted(set(rows["run"]))
    rows["run"] = rows["run"].map({number: place for place, number in enumerate(used)})
    notes = list(dict.fromkeys(note for summary in summaries for note in summary.notes))
    return Summary(rows, [runs[number] for number in used], notes)


def provenance(summaries: Mapping[str, Summary]) -> Table:
    """Table of runs, one row each: name of the summary, number of measurements, device, commit, digest of the
    code, date."""
    return pd.DataFrame(
        [
            {
                "measured, points": f"{name}, {run['points']}",
                "on": re.sub(r"OpenCL [\d.]+ ", "", run["device"] or run["machine"]),
                "commit/code": f"{run['commit'] or 'no'}/{run['code']}",
                "date": run["date"],
            }
            for name, summary in summaries.items()
            for run in summary.runs
        ]
    )
