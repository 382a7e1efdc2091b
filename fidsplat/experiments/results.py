"""Results of the paper's experiments as a summary table each."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from fidsplat.experiments import angles, counts, localisation, trained, views
from fidsplat.experiments.methods import IDEAL
from fidsplat.experiments.summary import Summary, join, read_summary, records_of, summarise
from fidsplat.experiments.sweep import Record
from fidsplat.util.errors import InputError

ALLOWED_GAP = {"exact": 0.2, "fitted": 1.0}
"""allowed gap below the limit of the ideal texture in degrees, by mixture"""
NEVER = 90.0
"""gap in degrees of a code that is never read"""
Rows = Iterator[dict[str, Any]]


class _Scan(NamedTuple):
    tilts: list[float]
    found: str
    read: str


Ideals = dict[tuple, dict[str, _Scan]]
"""protocol and marker -> readings of the ideal texture by detector"""


class Kind(NamedTuple):
    """Conversion of the results of an experiment to rows."""

    about: tuple[str, ...]
    """key columns of a row"""
    columns: tuple[str, ...]
    rows: Callable[[Ideals, Record], Rows]
    """rows of a record, compared with readings of the ideal texture"""


def load(folders: Sequence[Path]) -> dict[str, Summary]:
    """Results of folders by experiment, raw (NAME.jsonl) or summarised (NAME.csv).

    Of two measurements the larger one is used.

    Raises InputError when there are none, or they are of another version.
    """
    where, found = ", ".join(map(str, folders)), {}
    for name, kind in KINDS.items():
        records = [record for folder in folders for record in records_of(folder, name)]
        there = [read_summary(file) for folder in folders if (file := folder / f"{name}.csv").is_file()]
        try:
            if records:
                ideals = _ideals(records) if name == angles.NAME else {}
                columns = (*kind.about, "amount", *kind.columns)
                there.insert(0, summarise(records, partial(kind.rows, ideals), columns))
            if there:
                found[name] = join(there, kind.about)
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


def _counts_rows(ideals: Ideals, record: Record) -> Rows:
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


def _scans(record: Record) -> dict[str, _Scan]:
    """Readings by detector."""
    tilts = angles.parse_tilts(record.key["tilts"])
    found = record.result["readers"].items()
    return {name: _Scan(tilts, seen["found"], seen["read"]) for name, seen in found}


def _ideals(records: Iterable[Record]) -> Ideals:
    """Readings of the ideal texture by protocol and marker, from the longest scan."""
    found: Ideals = {}
    for record in records:
        if record.key["method"] == IDEAL:
            known = found.setdefault(_marker_of(record.key), {})
            for name, scan in _scans(record).items():
                known[name] = max((scan, known.get(name, scan)), key=lambda one: len(one.tilts))
    return found


def _marker_of(key: dict) -> tuple:
    return key["protocol"], key["category"], key["index"]


def _angles_rows(ideals: Ideals, record: Record) -> Rows:
    key = record.key
    ceilings = ideals.get(_marker_of(key), {})
    for reader, scan in _scans(record).items():
        row = {"protocol": key["protocol"], "category": key["category"], "marker": key["index"]}
        row |= {"method": key["method"], "reader": reader, "amount": len(scan.tilts), "tilts": key["tilts"]}
        row["found"], row["found_all"] = angles.largest(scan.tilts, scan.found)
        row["read"], row["read_all"] = angles.largest(scan.tilts, scan.read)
        if reader in ceilings:
            row |= _beside_ideal(scan, ceilings[reader], key["method"])
        yield row


def _beside_ideal(scan: _Scan, ideal: _Scan, method: str) -> dict[str, float | None]:
    """Gap between a scan and that of the ideal texture, on common tilts.

    `behind`, `behind_all`: degrees by which the largest tilt that is read, and the largest without a miss,
    lie below the ideal's; `NEVER` where there is none, None where the ideal has none. `missed` of `below`:
    tilts that are not read, up to the allowed gap below the one to which the ideal is read without a miss.
    """
    both = sorted(set(scan.tilts) & set(ideal.tilts))
    ours, theirs = _at(scan, both), _at(ideal, both)
    row: dict[str, float | None] = {}
    for name, own, ceiling in zip(
        ("behind", "behind_all"), angles.largest(both, ours), angles.largest(both, theirs), strict=True
    ):
        row[name] = None if ceiling is None else NEVER if own is None else ceiling - own
    ceiling = angles.largest(both, theirs)[1]
    if ceiling is not None:
        least = ceiling - ALLOWED_GAP.get(method.partition("/")[0], 0.0) + 1e-6
        hits = [hit for tilt, hit in zip(both, ours, strict=True) if tilt <= least]
        row |= {"missed": hits.count("0"), "below": len(hits)}
    return row


def _at(scan: _Scan, tilts: Iterable[float]) -> str:
    read = dict(zip(scan.tilts, scan.read, strict=True))
    return "".join(read[tilt] for tilt in tilts)


def _views_rows(ideals: Ideals, record: Record) -> Rows:
    key = record.key
    row = {name: key[name] for name in ("truth", "category", "method")} | {"marker": key["index"]}
    # of equally many views, the record with more metrics
    row["amount"] = key["views"] + 0.1 * bool(key["flip"]) + 0.2 * bool(key["lpips"])
    for name in ("psnr", "ssim", "flip", "lpips"):
        there = [value for value in record.result[name] or () if value is not None]
        row[name] = statistics.fmean(there) if there else None
    yield row


def _localisation_rows(ideals: Ideals, record: Record) -> Rows:
    """Rows by distance: medians over the tilts at which the marker was read."""
    key = record.key
    for distance in key["distances"]:
        seen = [view for view in record.result["views"] if view["distance_m"] == distance]
        read = [view for view in seen if view["position_mm"] is not None]
        row = {"category": key["category"], "method": key["method"], "marker": key["index"]}
        row |= {"distance_m": distance, "amount": len(seen), "read": len(read)}
        for name in ("position_mm", "angle_deg", "corners_px"):
            row[name] = statistics.median(view[name] for view in read) if read else None
        yield row


def _trained_rows(ideals: Ideals, record: Record) -> Rows:
    """A resumed training has no total time."""
    key, found = record.key, dict(record.result)
    whole = found["iterations"] == key["iterations"]
    row = {name: key[name] for name in ("category", "views", "seed")} | {"marker": key["index"]}
    row |= {name: found[name] for name in ("psnr", "ssim", "splats")}
    yield row | {"amount": key["iterations"], "seconds": found["seconds"] if whole else None}


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
        ("found", "found_all", "read", "read_all", "behind", "behind_all", "missed", "below"),
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
