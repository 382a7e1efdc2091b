"""Summary tables of the paper's experiments."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from fidsplat.experiments import angles, counts, localisation, trained, views
from fidsplat.experiments.summary import Summary, join, read_summary, summarise
from fidsplat.experiments.sweep import Record, folder_records
from fidsplat.util.errors import InputError

Rows = Iterator[dict[str, Any]]


class Kind(NamedTuple):
    """Conversion of the results of an experiment to rows."""

    keys: tuple[str, ...]
    """columns that identify a row"""
    columns: tuple[str, ...]
    rows: Callable[[Record], Rows]


def load(folders: Sequence[Path]) -> dict[str, Summary]:
    """Results of folders by experiment, raw (NAME.jsonl) or summarised (NAME.csv).

    Of two measurements the larger one is used.

    Raises InputError when there are none, or they are from another version.
    """
    where, found = ", ".join(map(str, folders)), {}
    for name, kind in KINDS.items():
        records = [record for folder in folders for record in folder_records(folder, name)]
        summaries = [read_summary(file) for folder in folders if (file := folder / f"{name}.csv").is_file()]
        try:
            if records:
                summaries.insert(0, summarise(records, kind.rows, (*kind.keys, "amount", *kind.columns)))
            if summaries:
                found[name] = join(summaries, kind.keys)
                rows = found[name].rows
                rows[list(kind.columns)] = rows[list(kind.columns)].apply(pd.to_numeric)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"results of {name} in {where} are damaged or of another version of fidsplat "
                f"({type(error).__name__}: {error}); measure again with --overwrite"
            ) from error
    if not found:
        raise InputError(f"no results in {where}; run fidsplat experiment all first, or give their folder")
    return found


def _counts_rows(record: Record) -> Rows:
    key, found = record.key, record.result
    for mixture, numbers in found["gaussians"].items():
        seconds = found["seconds"][mixture]
        row = {"category": key["category"], "marker": key["index"], "mixture": mixture}
        row |= {"amount": len(seconds), "gaussians": numbers["rectangles"]}
        row |= {f"gaussians_of_{name}": numbers.get(name) for name in ("runs", "cells")}
        for name in ("components", "cells", "runs", "rectangles"):
            row |= {f"{name}_{colour}": found[name][colour] for colour in ("dark", "light")}
        spread = statistics.stdev(seconds) if len(seconds) > 1 else 0.0
        yield row | {"seconds": statistics.median(seconds), "seconds_spread": spread}


def _angles_rows(record: Record) -> Rows:
    key, tilts = record.key, angles.parse_tilts(record.key["tilts"])
    for reader, hits in record.result["readers"].items():
        row = {"protocol": key["protocol"], "category": key["category"], "marker": key["index"]}
        row |= {"method": key["method"], "reader": reader, "amount": len(tilts), "tilts": key["tilts"]}
        for name in ("found", "read"):
            row[name], row[f"{name}_all"] = angles.largest(tilts, hits[name])
        yield row


def _views_rows(record: Record) -> Rows:
    key = record.key
    row = {name: key[name] for name in ("truth", "category", "method")} | {"marker": key["index"]}
    # prefer records with more views, then with more metrics
    row["amount"] = key["views"] + 0.1 * bool(key["flip"]) + 0.2 * bool(key["lpips"])
    for name in ("psnr", "ssim", "flip", "lpips"):
        values = [value for value in record.result[name] or () if value is not None]
        row[name] = statistics.fmean(values) if values else None
    yield row


def _localisation_rows(record: Record) -> Rows:
    """Rows by distance: medians over the tilts at which the marker was read."""
    key = record.key
    for distance in key["distances"]:
        every = [view for view in record.result["views"] if view["distance_m"] == distance]
        read = [view for view in every if view["position_mm"] is not None]
        row = {"category": key["category"], "method": key["method"], "marker": key["index"]}
        row |= {"distance_m": distance, "amount": len(every), "read": len(read)}
        for name in ("position_mm", "angle_deg", "corners_px"):
            row[name] = statistics.median(view[name] for view in read) if read else None
        yield row


def _trained_rows(record: Record) -> Rows:
    """Row of a training; a resumed one has no total time."""
    key, found = record.key, record.result
    row = {name: key[name] for name in ("category", "views", "seed")} | {"marker": key["index"]}
    row |= {name: found[name] for name in ("psnr", "ssim", "splats")}
    complete = found["iterations"] == key["iterations"]
    yield row | {"amount": key["iterations"], "seconds": found["seconds"] if complete else None}


KINDS = {
    counts.NAME: Kind(
        ("category", "marker", "mixture"),
        (
            "gaussians", "gaussians_of_runs", "gaussians_of_cells",
            *(f"{n}_{c}" for n in ("components", "cells", "runs", "rectangles") for c in ("dark", "light")),
            "seconds", "seconds_spread",
        ),
        _counts_rows,
    ),
    angles.NAME: Kind(
        ("protocol", "category", "marker", "method", "reader"),
        ("found", "found_all", "read", "read_all"),
        _angles_rows,
    ),
    views.NAME: Kind(
        ("truth", "category", "method", "marker"), ("psnr", "ssim", "flip", "lpips"), _views_rows
    ),
    localisation.NAME: Kind(
        ("category", "method", "marker", "distance_m"),
        ("read", "position_mm", "angle_deg", "corners_px"),
        _localisation_rows,
    ),
    trained.NAME: Kind(
        ("category", "views", "marker", "seed"), ("psnr", "ssim", "splats", "seconds"), _trained_rows
    ),
}  # fmt: skip
