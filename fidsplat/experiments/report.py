"""Report of the paper's experiments: tables of the paper and of fidsplat, and charts."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from fidsplat.experiments import angles, counts, localisation, views
from fidsplat.experiments.charts import bars, chart, legend_above
from fidsplat.experiments.methods import FILTERS, IDEAL, mixtures, with_linear_light
from fidsplat.experiments.pages import NOTHING, fixed, number, page_and_folder, write_page
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS, PROTOCOLS
from fidsplat.experiments.summary import Row, Summary, Table, join, provenance, read_summary, summarise
from fidsplat.experiments.sweep import Record, folder_records
from fidsplat.experiments.views import LINEAR, TRUTHS
from fidsplat.util.errors import InputError, damaged_data

_READERS = {"apriltag": ("pupil", "aruco"), "qr": ("zxing-tall", "zxing", "cv2")}
"""detectors of each kind, sorted by their limit on the ideal texture; the first available one is reported"""
_TRUTHS = (("exact", "blender-raw"), ("blender-standard", "exact-linear"))
"""ground truths of display values and of linear light; the first available one is reported"""
PAPER, TRAINED = "paper, its own", "paper, 2DGS 17 views"
_NAN = float("nan")


def make_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write a report in Markdown with its charts and summaries; returns the files, the report first.
    The summaries suffice to make the same report again.

    Args:
        folders: folders with results, see `load`.
        out: folder for report.md and its files; or a name that ends in .md, whose files are written to a
            folder of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    loaded = load(folders)
    page, folder = page_and_folder(out, "results.md.j2")
    summaries = {name: summary.write(folder / f"{name}.csv") for name, summary in loaded.items()}
    rows = {name: summary.rows for name, summary in summaries.items()}
    sections = {
        counts.NAME: _counts,
        angles.NAME: _angles,
        views.NAME: _views,
        localisation.NAME: lambda own, _: _localisation(own),
    }
    context: dict[str, Any] = {
        name: section(rows[name], folder) if name in rows else None for name, section in sections.items()
    }
    context |= {
        "sheets": sorted(sheet.name for sheet in folder.glob("sheet-*.png")),
        "runs": provenance({f"`{name}`": summary for name, summary in summaries.items()}),
        "training_seconds": TRAINING_SECONDS,
        "notes": list(dict.fromkeys(note for summary in summaries.values() for note in summary.notes)),
    }
    write_page(page, folder, "results.md.j2", context)
    return [page, *(folder / f"{name}.csv" for name in loaded), *sorted(folder.glob("*.svg"))]


def category_order(names: Iterable[str]) -> list[str]:
    """Occurring categories in the order of the paper."""
    names = set(names)
    return [name for name in CATEGORIES if name in names]


def method_order(names: Iterable[str]) -> list[str]:
    """Occurring methods of the report: the ideal, mixtures without a low-pass, trained models."""
    known = with_linear_light(f"{mixture}/{name}" for mixture in mixtures() for name in FILTERS)
    known = [name for name in known if not name.endswith("/screen")]
    names = set(names)
    return [name for name in (IDEAL, *known, *(f"2dgs-{n}" for n in COLLECTIONS)) if name in names]


def _titles(categories: Iterable[str]) -> list[str]:
    return [CATEGORIES[name].title for name in categories]


def _counts(rows: Table, folder: Path) -> dict[str, Table]:
    """Tables 1 and 2, and their charts."""
    categories = category_order(rows["category"])
    used = [name for name in mixtures() if name in set(rows["mixture"])]
    means = rows.pivot_table(["gaussians", "seconds"], "category", "mixture", sort=False).reindex(categories)
    first = rows.groupby(["category", "marker"]).first().groupby("category").mean(numeric_only=True)
    sizes, seconds = [], []
    for name in categories:
        category, values = CATEGORIES[name], first.loc[name]
        sizes.append(
            {
                "category": category.title,
                "characters": category.length or NOTHING,
                "QR version": category.version or NOTHING,
                "modules a side": 8 if category.version is None else 17 + 4 * category.version,
                "components": f"{values['components_dark'] + values['components_light']:.0f}",
                "rectangles": f"{values['rectangles_dark'] + values['rectangles_light']:.0f}",
            }
            | {f"splats, {m}": fixed(means["gaussians"][m][name], 0) for m in used}
        )
        seconds.append({"category": category.title} | {m: number(means["seconds"][m][name]) for m in used})
    seconds.append({"category": "all"} | {m: number(means["seconds"][m].mean()) for m in used})
    seconds.append({"category": PAPER} | {m: f"{CONSTRUCTION_SECONDS:.2f}" for m in used})
    for file, column, label in (
        ("counts.svg", "gaussians", "splats of a marker"),
        ("seconds.svg", "seconds", "seconds from text to splats"),
    ):
        with chart(folder / file) as (figure, (axes,)):
            series = {f"mixture {m}": means[column][m].tolist() for m in used}
            bars(axes, _titles(categories), series, logarithmic=True)
            if column == "seconds":
                for time, style, text in (
                    (CONSTRUCTION_SECONDS, "--", "paper, its own, mean"),
                    (TRAINING_SECONDS[17], ":", "paper, training 2DGS, 17 views"),
                ):
                    axes.axhline(time, color="#555555", linestyle=style, label=text)
            axes.set_ylabel(label)
            legend_above(figure, axes)
    return {"sizes": pd.DataFrame(sizes), "seconds": pd.DataFrame(seconds)}


def _angles(rows: Table, folder: Path) -> dict[str, Table]:
    """Table 3 for each protocol, and its chart."""
    rows = _best_reader(rows)
    categories, methods = category_order(rows["category"]), method_order(rows["method"])
    paper = {
        name: {key: "{:.1f}/{:.1f}".format(*value) for key, value in row.items()}
        for name, row in ANGLES.items()
    }
    paper_read = {name: {key: value[1] for key, value in row.items()} for name, row in ANGLES.items()}
    tables, series = {}, {}
    for protocol in (name for name in PROTOCOLS if name in set(rows["protocol"])):
        selected = rows[rows["protocol"] == protocol]
        cells = {
            key: f"{_angle(group['found'])}/{_angle(group['read'])}"
            for key, group in selected.groupby(["category", "method"])
        }
        # only this protocol is the paper's
        theirs = paper if protocol == "fixed-plane" else {}
        tables[protocol] = _table(categories, method_order(selected["method"]), cells, theirs)
        means = selected.groupby(["category", "method"])["read"].mean()
        series[protocol] = _series(categories, methods, means, paper_read)
    _panels(folder / "angles.svg", categories, series, "largest tilt that is read, degrees")
    return tables


def _best_reader(rows: Table) -> Table:
    """Rows of the best detector of each method."""
    ranks = {name: rank for names in _READERS.values() for rank, name in enumerate(names)}
    rank = rows["reader"].map(ranks)
    by_method = rank.groupby([rows["protocol"], rows["category"], rows["method"]])
    return rows[rank == by_method.transform("min")]


def _angle(values: Row) -> str:
    measured = values.dropna()
    if measured.empty:
        return "never"
    never = len(values) - len(measured)
    return f"{measured.mean():.1f}" + (f" ({never} of {len(values)} never)" if never else "")


def _views(rows: Table, folder: Path) -> dict:
    """Table 4 for ground truth of display values and of linear light, and its chart."""
    categories, measured = category_order(rows["category"]), set(rows["truth"])
    paper_psnr = {name: {key: value[0] for key, value in row.items()} for name, row in VIEWS.items()}
    tables, series = {}, {}
    for truth in filter(None, (next((n for n in names if n in measured), None) for names in _TRUTHS)):
        linear = truth in LINEAR
        selected = rows[rows["truth"] == truth]
        methods = method_order(selected["method"])
        means = selected.groupby(["category", "method"])[["psnr", "ssim"]].mean()
        cells = {key: f"{fixed(row.psnr)}/{fixed(row.ssim, 3)}" for key, row in means.iterrows()}
        paper = {
            name: {key: f"{value[0]:.1f}/{value[1]:.2f}" for key, value in row.items()}
            for name, row in VIEWS.items()
            if linear  # as in the paper, whose ground truth is Blender's
        }
        tables[truth] = {"title": TRUTHS[truth], "rows": _table(categories, methods, cells, paper)}
        # compare methods that blend in the light (linear or display) in which the ground truth averages
        ending = "light" if linear else "best"
        shown = [method for method in methods if "/" not in method or method.endswith(f"/{ending}")]
        title = f"mixtures rendered as `{ending}` against\n{TRUTHS[truth]}"
        series[title] = _series(categories, shown, means["psnr"], paper_psnr)
    _panels(folder / "psnr.svg", categories, series, "PSNR, dB")
    count = {name: int(rows[name].notna().sum()) for name in ("flip", "lpips")}
    return {"tables": tables, "views": int(rows["amount"].max()), "rows": len(rows), "measured": count}


def _localisation(rows: Table) -> Table:
    """Median position error by every second distance, and number of views that were read."""
    methods = method_order(rows["method"])
    rows = rows[rows["distance_m"].isin(sorted(set(rows["distance_m"]))[::2])]
    table = []
    for (category, distance), group in rows.groupby(["category", "distance_m"]):
        row = {"marker, distance": f"{CATEGORIES[str(category)].title}, {distance:g} m"}
        for method in methods:
            selected = group[group["method"] == method]
            read, amount = selected["read"].sum(), selected["amount"].sum()
            missed = f" ({read}/{amount})" if read < amount else ""
            row[method] = number(selected["position_mm"].median()) + missed if read else "not read"
        table.append(row)
    return pd.DataFrame(table)


def _table(
    categories: Sequence[str],
    methods: Sequence[str],
    cells: Mapping[tuple[str, str], str],
    paper: Mapping[str, Mapping],
) -> Table:
    """Table by category: the paper's figures if any, then fidsplat's by category and method."""
    theirs = {PAPER: "ours", TRAINED: 17} if paper else {}
    return pd.DataFrame(
        [
            {"category": CATEGORIES[category].title}
            | {text: paper.get(category, {}).get(key, NOTHING) for text, key in theirs.items()}
            | {method: cells.get((category, method), NOTHING) for method in methods}
            for category in categories
        ]
    )


def _series(
    categories: Sequence[str], methods: Sequence[str], values: Row, paper: Mapping[str, Mapping]
) -> dict[str, list[float]]:
    """Figures of fidsplat by method, then the paper's, for `_panels`."""
    names = {m: f"mixture {m.partition('/')[0]}" if "/" in m else m for m in methods}
    measured = {name: [values.get((c, method), _NAN) for c in categories] for method, name in names.items()}
    theirs = ((PAPER, "ours"), (TRAINED, 17))
    return measured | {text: [paper.get(c, {}).get(key, _NAN) for c in categories] for text, key in theirs}


def _panels(
    file: Path, categories: Sequence[str], panels: dict[str, dict[str, list[float]]], unit: str
) -> None:
    """Write panels of bars by category with one legend."""
    names = list(dict.fromkeys(name for series in panels.values() for name in series))
    names.sort(key=lambda name: (name in (PAPER, TRAINED), name != IDEAL))
    missing = [_NAN] * len(categories)
    with chart(file, len(panels), (4.5 * len(panels) + 2, 4.2)) as (figure, axes):
        for axis, (title, series) in zip(axes, panels.items(), strict=True):
            bars(axis, _titles(categories), {name: series.get(name, missing) for name in names})
            axis.set_title(title)
            axis.tick_params(axis="x", labelsize=8)
        axes[0].set_ylabel(unit)
        legend_above(figure, axes[0])


TRAINING_SECONDS = {3: 423.0, 5: 392.0, 9: 386.0, 17: 371.0}
"""table 2: mean training time of 2DGS in seconds by number of views"""
CONSTRUCTION_SECONDS = 1.04
"""table 2: mean time of the paper's method in seconds over all categories"""

ANGLES = {
    "small": {"ours": (80.0, 80.0), 3: (73.8, 60.0), 5: (79.4, 68.2), 9: (81.6, 75.4), 17: (81.0, 79.0)},
    "medium": {"ours": (81.4, 81.2), 3: (76.8, 59.0), 5: (80.4, 68.0), 9: (81.6, 76.6), 17: (81.8, 75.2)},
    "large": {"ours": (82.0, 81.8), 3: (77.8, 58.0), 5: (80.0, 67.2), 9: (82.0, 77.8), 17: (82.2, 76.6)},
    "huge": {"ours": (84.0, 82.2), 3: (77.8, 56.8), 5: (79.4, 65.4), 9: (82.2, 72.0), 17: (82.6, 75.4)},
}
"""table 3: largest tilt in degrees at which a code is detected, and decoded; the table has no AprilTags"""

VIEWS = {
    "apriltag": {
        "ours": (27.97, 0.83, 0.05),
        3: (18.41, 0.90, 0.12), 5: (30.38, 0.98, 0.04), 9: (35.03, 0.99, 0.02), 17: (38.70, 0.99, 0.02),
    },
    "small": {
        "ours": (25.41, 0.83, 0.05),
        3: (19.86, 0.90, 0.12), 5: (26.90, 0.96, 0.04), 9: (33.82, 0.99, 0.02), 17: (37.21, 0.99, 0.02),
    },
    "medium": {
        "ours": (23.58, 0.84, 0.06),
        3: (19.64, 0.89, 0.12), 5: (26.97, 0.96, 0.04), 9: (33.52, 0.99, 0.02), 17: (36.10, 0.99, 0.02),
    },
    "large": {
        "ours": (21.25, 0.85, 0.10),
        3: (20.74, 0.90, 0.11), 5: (27.83, 0.97, 0.03), 9: (33.02, 0.99, 0.02), 17: (34.88, 0.99, 0.02),
    },
    "huge": {
        "ours": (18.80, 0.88, 0.08),
        3: (20.62, 0.91, 0.09), 5: (27.33, 0.97, 0.03), 9: (31.04, 0.99, 0.02), 17: (32.52, 0.99, 0.02),
    },
}  # fmt: skip
"""table 4: PSNR in dB, SSIM and LPIPS over 20 test views"""


Rows = Iterator[dict[str, Any]]


class Kind(NamedTuple):
    """Conversion of an experiment's results to rows."""

    keys: tuple[str, ...]
    """columns that identify a row"""
    columns: tuple[str, ...]
    rows: Callable[[Record], Rows]


def load(folders: Sequence[Path]) -> dict[str, Summary]:
    """Results of folders by experiment, raw (NAME.jsonl) or summarised (NAME.csv).

    For a point that was measured twice, the result with more measurements is used.

    Raises InputError if there are no results, or they are from another version.
    """
    where, results = ", ".join(map(str, folders)), {}
    for name, kind in KINDS.items():
        records = [record for folder in folders for record in folder_records(folder, name)]
        summaries = [read_summary(file) for folder in folders if (file := folder / f"{name}.csv").is_file()]
        with damaged_data(f"a result of {name} in {where}", "measure again with --overwrite"):
            if records:
                summaries.insert(0, summarise(records, kind.rows, (*kind.keys, "amount", *kind.columns)))
            if summaries:
                results[name] = join(summaries, kind.keys)
                rows = results[name].rows
                rows[list(kind.columns)] = rows[list(kind.columns)].apply(pd.to_numeric)
    if not results:
        raise InputError(f"results must be in {where}, got none; run fidsplat experiment all first")
    return results


def _counts_rows(record: Record) -> Rows:
    key, result = record.key, record.result
    for mixture, numbers in result["gaussians"].items():
        seconds = result["seconds"][mixture]
        row = {"category": key["category"], "marker": key["index"], "mixture": mixture}
        row |= {"amount": len(seconds), "gaussians": numbers["rectangles"]}
        row |= {f"gaussians_of_{name}": numbers.get(name) for name in ("runs", "cells")}
        for name in ("components", "cells", "runs", "rectangles"):
            row |= {f"{name}_{color}": result[name][color] for color in ("dark", "light")}
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
    # prefer records with more views, and among these records with more metrics
    row["amount"] = key["views"] + 0.1 * bool(key["flip"]) + 0.2 * bool(key["lpips"])
    for name in ("psnr", "ssim", "flip", "lpips"):
        values = [value for value in record.result[name] or () if value is not None]
        row[name] = statistics.fmean(values) if values else None
    yield row


def _localisation_rows(record: Record) -> Rows:
    """Rows by distance, with medians over the tilts at which the marker was read."""
    key = record.key
    for distance in key["distances"]:
        every = [view for view in record.result["views"] if view["distance_m"] == distance]
        read = [view for view in every if view["position_mm"] is not None]
        row = {"category": key["category"], "method": key["method"], "marker": key["index"]}
        row |= {"distance_m": distance, "amount": len(every), "read": len(read)}
        for name in ("position_mm", "angle_deg", "corners_px"):
            row[name] = statistics.median(view[name] for view in read) if read else None
        yield row


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

}  # fmt: skip
