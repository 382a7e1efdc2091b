"""Results as small CSV tables, preceded by lines with facts of the runs.

A summary has a row for each result, with the `amount` of measurements in it and the number of its `run`.
Lines that begin with "# " hold the facts of the runs, notes, and two lists of columns: `empty` columns, and
`repeated` columns, where an empty cell has the text of the cell above.
"""

from __future__ import annotations

import io
import json
import math
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
Frame: TypeAlias = Any
"""a `pandas.DataFrame`; the types of its cells are unknown"""
Row: TypeAlias = Any
"""a `pandas.Series`"""


@dataclass(eq=False)
class Summary:
    """A table of results."""

    rows: Frame
    runs: list[dict[str, Any]]
    """facts of each run (`fidsplat.util.provenance.run_facts`), and its number of `points`"""
    notes: list[str] = field(default_factory=list)
    """notes for readers of the numbers"""

    def write(self, file: Path) -> Summary:
        """Write the table, with numbers to four digits; returns it as read from the file.

        Reading back the rounded numbers makes reports of raw results and of summaries equal.

        Raises InputError when the file cannot be written.
        """
        empty = [name for name in self.rows if len(self.rows) and self.rows[name].isna().all()]
        rows = self.rows.drop(columns=empty)
        repeated = [name for name in rows if _has_text(rows[name])]
        lines = [{"run": run} for run in self.runs] + [{"note": note} for note in self.notes]
        lines += [{name: names} for name, names in (("empty", empty), ("repeated", repeated)) if names]
        for name in repeated:
            rows[name] = rows[name].mask(rows[name].eq(rows[name].shift()), "")
        text = "".join(f"{_MARK}{json.dumps(line)}\n" for line in lines)
        text += rows.to_csv(index=False, float_format="%.4g", lineterminator="\n")
        write_file(file, text)
        return read_summary(file)


def summarise(
    records: Iterable[Record],
    rows_of: Callable[[Record], Iterable[dict[str, Any]]],
    columns: Iterable[str],
) -> Summary:
    """Table of the rows of records."""
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
    """Read a file of `Summary.write`. Raises InputError for another file."""
    try:
        lines = read_text(file).splitlines()
        facts = [from_json(line.removeprefix(_MARK)) for line in lines if line.startswith(_MARK)]
        if not all(isinstance(one, dict) for one in facts):
            raise ValueError("the lines before its table must be facts")
        repeated = [name for one in facts for name in one.get("repeated", ())]
        # only empty cells are missing values: "None" is text, and a column of texts may contain numbers
        rows = pd.read_csv(
            io.StringIO("\n".join(lines[len(facts) :])),
            dtype=dict.fromkeys(repeated, str),
            keep_default_na=False,
            na_values=[""],
        )
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {file}: {error}") from error
    runs = [one["run"] for one in facts if "run" in one]
    if "run" not in rows or not runs:
        raise InputError(f"{file} holds no summary of results of fidsplat; give another folder")
    for name in (name for one in facts for name in one.get("empty", ())):
        rows[name] = math.nan
    rows[repeated] = rows[repeated].ffill()
    return Summary(rows, runs, [one["note"] for one in facts if "note" in one])


def _has_text(column: Frame) -> bool:
    """Whether a column has a text in every row."""
    return pd.api.types.is_string_dtype(column) and bool(column.notna().all() and (column != "").all())


def join(summaries: Sequence[Summary], keys: Sequence[str]) -> Summary:
    """Join tables of one kind. Of rows with equal keys, the first one with the largest `amount` remains."""
    frames, runs = [], []
    for summary in summaries:
        frames.append(summary.rows.assign(run=summary.rows["run"] + len(runs)))
        runs += summary.runs
    rows = pd.concat(frames, ignore_index=True)
    chosen = rows.sort_values("amount", ascending=False, kind="stable").drop_duplicates(list(keys))
    rows = rows.loc[sorted(chosen.index)].reset_index(drop=True)
    # a repeated report reads its own earlier tables, which may contribute no row
    used = sorted(set(rows["run"]))
    rows["run"] = rows["run"].map({number: place for place, number in enumerate(used)})
    notes = list(dict.fromkeys(note for summary in summaries for note in summary.notes))
    return Summary(rows, [runs[number] for number in used], notes)


def provenance(summaries: Mapping[str, Summary]) -> Frame:
    """Table of runs by the name of their summary: points, device, commit, code and date."""
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
