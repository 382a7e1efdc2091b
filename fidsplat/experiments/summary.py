"""Results as tables that are small enough to be kept beside a page: CSV below lines of facts.

A summary has a row for each thing that was measured, with the `amount` of measurements in it and the number
of the `run` that it is of. The facts of the runs stand first, each in a line that begins with "# ", and how
to read the rest: columns that are `empty`, and those of words that are `repeated` from row to row, where an
empty cell means what the one above does.
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

from fidsplat.experiments.sweep import Record, read_records
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, read_text

_MARK = "# "
Frame: TypeAlias = Any
"""a `pandas.DataFrame`, which has no types that could be followed into its cells"""
Row: TypeAlias = Any
"""a `pandas.Series`"""


@dataclass(eq=False)
class Summary:
    """One table of results."""

    rows: Frame
    runs: list[dict[str, Any]]
    """facts of each run (`fidsplat.util.provenance.run_facts`), and its `points`: how many it measured"""
    notes: list[str] = field(default_factory=list)
    """what a reader must know of these numbers besides"""

    def write(self, file: Path) -> Summary:
        """Write the table, numbers to four digits, columns without any by their names alone; returns what a
        reader of the file gets, so that pages are the same whether they are made of raw results or of their
        summary.

        Raises InputError when the file cannot be written."""
        empty = [name for name in self.rows if len(self.rows) and self.rows[name].isna().all()]
        heads: list[dict[str, Any]] = [{"run": run} for run in self.runs]
        heads += [{"note": note} for note in self.notes]
        heads += [{"empty": empty}] if empty else []
        rows = self.rows.drop(columns=empty)
        repeated = [name for name in rows if _words(rows[name])]
        heads += [{"repeated": repeated}] if repeated else []
        for name in repeated:
            rows[name] = rows[name].mask(rows[name].eq(rows[name].shift()), "")
        text = "".join(f"{_MARK}{json.dumps(head)}\n" for head in heads)
        text += rows.to_csv(index=False, float_format="%.4g", lineterminator="\n")
        with atomic_write(file) as stream:
            stream.write(text.encode())
        return read_summary(file)


def summarise(
    records: Iterable[Record],
    rows_of: Callable[[Record], Iterable[dict[str, Any]]],
    columns: Iterable[str],
) -> Summary:
    """The table of some records, each of which gives any number of rows."""
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
    """Read what `Summary.write` wrote. Raises InputError for another file."""
    try:
        text = read_text(file)
        lines = text.splitlines()
        heads = [from_json(line.removeprefix(_MARK)) for line in lines if line.startswith(_MARK)]
        if not all(isinstance(head, dict) for head in heads):
            raise ValueError("a line before its table holds no facts")
        repeated = [name for head in heads for name in head.get("repeated", ())]
        # an empty cell alone is none: the word "None" is one, and so is a number among words
        rows = pd.read_csv(
            io.StringIO("\n".join(lines[len(heads) :])),
            dtype=dict.fromkeys(repeated, str),
            keep_default_na=False,
            na_values=[""],
        )
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {file}: {error}") from error
    if "run" not in rows or not any("run" in head for head in heads):
        raise InputError(f"{file} is no summary of results of fidsplat; give another folder")
    runs = [head["run"] for head in heads if "run" in head]
    for name in (name for head in heads for name in head.get("empty", ())):
        rows[name] = math.nan
    for name in repeated:
        rows[name] = rows[name].ffill()
    return Summary(rows, runs, [head["note"] for head in heads if "note" in head])


def _words(column: Frame) -> bool:
    """Whether a column has words in every row."""
    return pd.api.types.is_string_dtype(column) and bool(column.notna().all() and (column != "").all())


def join(summaries: Sequence[Summary], about: Sequence[str]) -> Summary:
    """Several tables of one kind as one. Of rows that are equal in the columns `about` the one stays whose
    `amount` of measurements is the largest, and of such the first."""
    frames, runs = [], []
    for summary in summaries:
        frames.append(summary.rows.assign(run=summary.rows["run"] + len(runs)))
        runs += summary.runs
    rows = pd.concat(frames, ignore_index=True)
    chosen = rows.sort_values("amount", ascending=False, kind="stable").drop_duplicates(list(about))
    rows = rows.loc[sorted(chosen.index)].reset_index(drop=True)
    # a report that is made again finds the tables of the one before, and needs none of their rows
    used = sorted(set(rows["run"]))
    rows["run"] = rows["run"].map({number: place for place, number in enumerate(used)})
    notes = list(dict.fromkeys(note for summary in summaries for note in summary.notes))
    return Summary(rows, [runs[number] for number in used], notes)


def provenance(summaries: Mapping[str, Summary]) -> Frame:
    """What made the numbers: a row for each run of each summary, by what it measured."""
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


def records_of(folder: Path, name: str) -> list[Record]:
    """The records of an experiment in a folder, shards that were not merged included."""
    files = [folder / f"{name}.jsonl", *sorted(folder.glob(f"{name}-*-of-*.jsonl"))]
    return [record for file in files for record in read_records(file)]
