"""Report of the test bench of tag detectors: failure curves, tables, and a CSV file of all measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from fidsplat.experiments.charts import COLORS, chart, legend_above
from fidsplat.experiments.pages import NOTHING, page_and_folder, write_page
from fidsplat.experiments.summary import Summary, Table, summarise
from fidsplat.experiments.sweep import Record
from fidsplat.experiments.tag_causes import CAUSES
from fidsplat.experiments.tags import FAMILIES, NAME, NONE, OWN, rows_of
from fidsplat.vision.readers import TITLES

_ERRORS = ("corner_px", "rotation_deg", "translation_percent")
_GROUP = ("scene", "family", "detector", "cause", "severity")
PRECISE = 1.0
"""maximum RMS error in pixels of the corners of a precise detection"""
UNBROKEN = "none"
"""cell of a detector that reads at least half of the views at all severities"""
ALWAYS = "always"
"""cell of a detector that reads less than half of the views without a cause"""
_COLUMNS = 4
"""panels per row"""


def view_table(records: Sequence[Record]) -> Summary:
    """Table with one row per view and detector."""
    return summarise(records, rows_of, (*_GROUP, "read", *_ERRORS))


def statistics_of(rows: Table, seed: int, by: Sequence[str] = _GROUP) -> Table:
    """Detection rates and errors of groups of views, with 95 % intervals."""
    return pd.DataFrame(
        dict(zip(by, names, strict=True)) | _statistics(group, seed)
        for names, group in rows.groupby(list(by), sort=False)
    )


def _statistics(group: Table, seed: int) -> dict[str, Any]:
    read = group[group["read"]]
    row: dict[str, Any] = {"images": len(group)}
    for name, hits in (("rate", len(read)), ("precise", int((read["corner_px"] <= PRECISE).sum()))):
        row[name] = hits / len(group)
        row[f"{name}_low"], row[f"{name}_high"] = wilson(hits, len(group))
    for name, statistics in (
        ("corner_px", {"rms": root_mean_square}),
        *((name, {"p50": percentile(50), "p99": percentile(99)}) for name in _ERRORS[1:]),
    ):
        values = read[name].to_numpy(float)
        for ending, statistic in statistics.items():
            row[f"{name}_{ending}"] = float(statistic(values)) if len(values) else math.nan
            row[f"{name}_{ending}_low"], row[f"{name}_{ending}_high"] = bootstrap(values, statistic, seed)
    return row


def breaking_severity(severities: Sequence[float], rates: Sequence[float]) -> float | None:
    """Severity at which a rate falls below one half, by interpolation; None if it does not."""
    points = sorted(zip(severities, rates, strict=True))
    if not points or points[0][1] < 0.5:
        return points[0][0] if points else None
    for (s0, r0), (s1, r1) in pairwise(points):
        if r1 < 0.5:
            return s0 + (s1 - s0) * (r0 - 0.5) / (r0 - r1)
    return None


def breaks_of(rates: Table) -> Table:
    """Table of causes and families with the amount at which each detector reads half of the views.

    rates: `statistics_of` by family, detector, cause and severity.
    """
    table = []
    for cause in (name for name in CAUSES if name in set(rates["cause"])):
        selected = rates[rates["cause"].isin((cause, NONE))]
        for family in (name for name in FAMILIES if name in set(rates["family"])):
            row = {"cause": f"{CAUSES[cause].title} [{CAUSES[cause].unit}]"}
            row |= {"up to": CAUSES[cause].text(1.0), "family": family.rpartition(":")[2]}
            for detector in _detectors(rates):
                measured = selected[(selected["family"] == family) & (selected["detector"] == detector)]
                severity = breaking_severity(measured["severity"].tolist(), measured["rate"].tolist())
                cell = CAUSES[cause].text(severity) if severity else ALWAYS
                cell = UNBROKEN if severity is None else cell
                row[detector] = cell if len(measured) else NOTHING
            table.append(row)
    return pd.DataFrame(table)


def compact(breaks: Table) -> Table:
    """Table of `breaks_of` with one row per cause and one column per family."""
    detectors = list(breaks.columns[3:])
    names = {
        family: [name for name in detectors if (rows[name] != NOTHING).any()]
        for family, rows in breaks.groupby("family", sort=False)
    }
    return pd.DataFrame(
        {"cause": cause, "up to": rows["up to"].iloc[0]}
        | {
            f"{row['family']}: {'/'.join(names[row['family']])}": "/".join(row[names[row["family"]]])
            for _, row in rows.iterrows()
        }
        for cause, rows in breaks.groupby("cause", sort=False)
    )


def _detectors(rates: Table) -> list[str]:
    known = [*TITLES, OWN]
    names = dict.fromkeys(rates["detector"])
    return sorted(names, key=lambda name: known.index(name) if name in known else len(known))


def _errors(statistics: Table) -> Table:
    """Table of the errors of each detector, with intervals."""

    def cell(row: Any, name: str) -> str:
        if math.isnan(row[name]):
            return NOTHING
        low, high = (row[f"{name}_{end}"] for end in ("low", "high"))
        return f"{row[name]:.2g} ({low:.2g} to {high:.2g})"

    return pd.DataFrame(
        {
            "detector": f"{row['detector']}, {row['family'].rpartition(':')[2]}",
            "read [%]": f"{100 * row['rate']:.0f} ({100 * row['rate_low']:.0f} to "
            f"{100 * row['rate_high']:.0f})",
            "corners, RMS [px]": cell(row, "corner_px_rms"),
            "rotation, p50 [deg]": cell(row, "rotation_deg_p50"),
            "p99": cell(row, "rotation_deg_p99"),
            "translation, p50 [%]": cell(row, "translation_percent_p50"),
            "p99 [%]": cell(row, "translation_percent_p99"),
        }
        for _, row in statistics.iterrows()
    )


def write_report(records: Sequence[Record], folder: Path, out: Path, seed: int) -> tuple[list[Path], Table]:
    """Write tags.csv into the folder of results, and the page with its charts.

    out: folder for report.md and its charts, or FILE.md, with a folder of that name for its charts.

    Returns the files, starting with the page, and the table of `breaks_of`.
    """
    summary, (page, charts) = view_table(records), page_and_folder(out, "tags.md.j2")
    views = summary.rows
    views["read"] = views["read"].astype(bool)
    rates = statistics_of(views, seed)
    points = zip(rates["cause"], rates["severity"], strict=True)
    amounts = ["" if cause == NONE else CAUSES[cause].text(severity) for cause, severity in points]
    table = Summary(rates.assign(amount=amounts, run=0), summary.runs)
    table.write(folder / f"{NAME}.csv")
    pooled = statistics_of(views, seed, _GROUP[1:])
    files = []
    groups = dict.fromkeys(CAUSES[name].group for name in pooled["cause"] if name != NONE)
    for group in groups:
        causes = [name for name in CAUSES if CAUSES[name].group == group and name in set(pooled["cause"])]
        count = math.ceil(len(causes) / _COLUMNS)
        for k in range(count):
            ending = f"-{k + 1}" if count > 1 else ""
            file = charts / f"{group.replace(' ', '-')}{ending}.png"
            _curves(pooled, causes[k * len(causes) // count : (k + 1) * len(causes) // count], file)
            files.append((group, file))
    breaks = breaks_of(pooled)
    detectors = _detectors(pooled)
    undegraded = pooled[pooled["cause"] == NONE]
    points = table.rows.groupby([name for name in _GROUP if name != "detector"])["images"].max()
    context = {
        "figures": [{"title": group, "file": file.name} for group, file in files],
        "breaks": compact(breaks),
        "precise": PRECISE,
        "errors": _errors(undegraded),
        "detectors": [f"`{name}`: {TITLES[name]}" for name in detectors if name in TITLES],
        "scenes": " and ".join(dict.fromkeys(views["scene"])),
        "undegraded": int(undegraded["images"].max()),
        "severities": pooled[pooled["cause"] != NONE].groupby("cause")["severity"].nunique().max(),
        "views": points.max(),
        "points": f"{len(points):,}",
        "images": f"{points.sum():,}",
    }
    write_page(page, charts, "tags.md.j2", context)
    return [page, folder / f"{NAME}.csv", *(file for _, file in files)], breaks


def _curves(rates: Table, causes: Sequence[str], file: Path) -> None:
    """Write a chart of detection rates by severity with Wilson intervals: a row per family, a column per
    cause."""
    families = [name for name in FAMILIES if name in set(rates["family"])]
    detectors = _detectors(rates)
    size = (2.2 * len(causes) + 0.8, 1.7 * len(families) + 0.9)
    with chart(file, len(causes), size, rows=len(families)) as (figure, axes):
        for place, (family, cause) in zip(axes, [(f, c) for f in families for c in causes], strict=True):
            for number, detector in enumerate(detectors):
                selected = rates[(rates["family"] == family) & (rates["detector"] == detector)]
                selected = selected[selected["cause"].isin((cause, NONE))].sort_values("severity")
                color = COLORS[number % len(COLORS)]
                x = selected["severity"].to_numpy()
                label = detector if place is axes[0] else None
                if not len(selected):
                    place.plot([], [], color=color, label=label)
                    continue
                place.plot(x, 100 * selected["rate"].to_numpy(), color=color, label=label, linewidth=1.3)
                low, high = (100 * selected[f"rate_{end}"].to_numpy() for end in ("low", "high"))
                place.fill_between(x, low, high, color=color, alpha=0.12, linewidth=0)
            place.set_xticks([0.0, 0.5, 1.0], ["", "", ""])
            place.set_ylim(-4, 104)
            if family == families[0]:
                place.set_title(CAUSES[cause].title, fontsize=9)
            if family == families[-1]:
                texts = [CAUSES[cause].text(severity) for severity in (0, 0.5, 1)]
                place.set_xticks([0.0, 0.5, 1.0], texts, fontsize=7)
                place.set_xlabel(CAUSES[cause].unit, fontsize=7)
            if cause == causes[0]:
                place.set_ylabel(f"{family.rpartition(':')[2]}\nread [%]", fontsize=8)
            place.tick_params(axis="y", labelsize=7)
        legend_above(figure, axes[0])


NORMAL = 1.959963984540054
"""quantile 0.975 of the standard normal distribution"""
RESAMPLES = 1000


def wilson(hits: int, count: int) -> tuple[float, float]:
    """Wilson score interval of a fraction (Wilson 1927); (0, 1) without measurements."""
    if count == 0:
        return 0.0, 1.0
    fraction, square = hits / count, NORMAL**2 / count
    middle = (fraction + square / 2) / (1 + square)
    half = NORMAL / (1 + square) * math.sqrt(fraction * (1 - fraction) / count + square / (4 * count))
    # without rounding errors at the ends 0 and 1
    return 0.0 if hits == 0 else middle - half, 1.0 if hits == count else middle + half


def bootstrap(
    values: np.ndarray, statistic: Callable[[np.ndarray], np.ndarray], seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of a statistic over resampled values (Efron 1979); NaN without values.

    statistic: (resamples, n) -> (resamples,).
    """
    values = np.asarray(values, np.float64)
    if not len(values):
        return math.nan, math.nan
    chosen = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(statistic(values[chosen]), (2.5, 97.5))
    return float(low), float(high)


def percentile(percent: float) -> Callable[[np.ndarray], np.ndarray]:
    """Statistic that computes a percentile along the last axis."""
    return lambda values: np.percentile(values, percent, axis=-1)


def root_mean_square(values: np.ndarray) -> np.ndarray:
    """Root mean square along the last axis."""
    return np.sqrt((np.asarray(values) ** 2).mean(-1))
