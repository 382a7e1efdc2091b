"""Report of the paper's experiments: tables of the paper and ours, and charts."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import pandas as pd

from fidsplat.experiments import angles, counts, localisation, trained, views
from fidsplat.experiments.charts import bars, chart, legend_above
from fidsplat.experiments.methods import FILTERS, IDEAL, mixtures, with_linear_light
from fidsplat.experiments.pages import NOTHING, fixed, number, places, write_page
from fidsplat.experiments.paper import ANGLES, CONSTRUCTION_SECONDS, TRAINING_SECONDS, VIEWS
from fidsplat.experiments.pictures import sheet_files
from fidsplat.experiments.results import load
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS, PROTOCOLS
from fidsplat.experiments.summary import Frame, Row, provenance
from fidsplat.experiments.views import LINEAR, TRUTHS
from fidsplat.util.files import atomic_write, open_input

_FURTHEST = {"apriltag": ("pupil", "aruco"), "qr": ("zxing-tall", "zxing", "cv2")}
"""detectors of each kind by limit on the ideal texture; the first available one is shown"""
_SHOWN_TRUTHS = (("exact", "blender-raw"), ("blender-standard", "exact-linear"))
"""ground truths of display values and of linear light; the first available one is shown"""
_COMMANDS = {trained.NAME: "baseline"}
"""commands of experiments with another name"""
PAPER, TRAINED = "paper, its own", "paper, 2DGS 17 views"


def make_report(folders: Sequence[Path], out: Path) -> list[Path]:
    """Write a report in Markdown with its charts, summaries and sheets; returns the files, the page first.
    From the folder of the summaries the same page can be made again.

    Args:
        folders: where results lie, see `fidsplat.experiments.results.load`, and sheets of pictures.
        out: a folder for report.md and all that belongs to it; or a name that ends in .md, and the rest goes
            into a folder of that name without .md.

    Raises InputError when there are no results or the folder cannot be written.
    """
    loaded = load(folders)
    page, folder = places(out)
    files = [folder / f"{name}.csv" for name in loaded]
    summaries = {
        name: summary.write(file) for (name, summary), file in zip(loaded.items(), files, strict=True)
    }
    rows = {name: summary.rows for name, summary in summaries.items()}
    context: dict = dict.fromkeys((counts.NAME, angles.NAME, views.NAME, localisation.NAME, trained.NAME))
    for name, tables in (
        (counts.NAME, _counts),
        (angles.NAME, _angles),
        (views.NAME, _views),
        (localisation.NAME, _localisation),
    ):
        if name in rows:
            context[name] = tables(rows[name], folder)
    if trained.NAME in rows:
        context[trained.NAME] = _trained(rows[trained.NAME], rows.get(views.NAME), rows.get(angles.NAME))
    sheets = next((found for place in (*folders, folder) if (found := sheet_files(place))), [])
    for sheet in sheets:
        if sheet.parent.resolve() != folder.resolve():
            with atomic_write(folder / sheet.name) as stream, open_input(sheet) as source:
                shutil.copyfileobj(source, stream)
    context |= {
        "sheets": [sheet.name for sheet in sheets],
        "runs": provenance(
            {f"`{_COMMANDS.get(name, name)}`": summary for name, summary in summaries.items()}
        ),
        "training_seconds": TRAINING_SECONDS,
        "notes": list(dict.fromkeys(note for summary in summaries.values() for note in summary.notes)),
    }
    write_page(page, folder, "results.md.j2", context)
    return [page, *files, *sorted(folder.glob("*.svg"))]


def category_order(names: Iterable[str]) -> list[str]:
    """Occurring categories in the paper's order."""
    there = set(names)
    return [name for name in CATEGORIES if name in there]


def method_order(names: Iterable[str]) -> list[str]:
    """Occurring methods that are shown: the ideal, mixtures without a low-pass, trained models."""
    own = with_linear_light(f"{mixture}/{name}" for mixture in mixtures() for name in FILTERS)
    known = [IDEAL, *(name for name in own if not name.endswith("/screen"))]
    there = set(names)
    return [name for name in (*known, *(f"2dgs-{n}" for n in COLLECTIONS)) if name in there]


def _titles(categories: Iterable[str]) -> list[str]:
    return [CATEGORIES[name].title for name in categories]


def _counts(rows: Frame, folder: Path) -> dict[str, Frame]:
    """Tables 1 and 2, and the chart of each."""
    categories = category_order(rows["category"])
    made = [name for name in mixtures() if name in set(rows["mixture"])]
    mean = rows.groupby(["category", "mixture"]).mean(numeric_only=True)
    first = rows.groupby(["category", "marker"]).first().groupby("category").mean(numeric_only=True)
    sizes, seconds = [], []
    for name in categories:
        category, own = CATEGORIES[name], first.loc[name]
        side = 8 if category.version is None else 17 + 4 * category.version
        row = {
            "category": category.title,
            "characters": category.length or NOTHING,
            "QR version": category.version or NOTHING,
            "modules a side": side,
        }
        for column, words in (("components", "components"), ("rectangles", "rectangles")):
            row[words] = f"{own[f'{column}_dark'] + own[f'{column}_light']:.0f}"
        sizes.append(row | {f"splats, {m}": fixed(mean["gaussians"].get((name, m)), 0) for m in made})
        seconds.append(
            {"category": category.title} | {m: number(mean["seconds"].get((name, m)), 2) for m in made}
        )
    every = mean["seconds"].groupby("mixture").mean()
    seconds.append({"category": "all"} | {m: number(every[m], 2) for m in made})
    seconds.append({"category": PAPER} | {m: f"{CONSTRUCTION_SECONDS:.2f}" for m in made})

    def of(column: str) -> dict[str, list[float]]:
        return {
            f"mixture {m}": [mean[column].get((name, m), float("nan")) for name in categories] for m in made
        }

    with chart(folder / "counts.svg") as (figure, (axes,)):
        bars(axes, _titles(categories), of("gaussians"), logarithmic=True)
        axes.set_ylabel("splats of a marker")
        legend_above(figure, axes)
    with chart(folder / "seconds.svg") as (figure, (axes,)):
        bars(axes, _titles(categories), of("seconds"), logarithmic=True)
        axes.axhline(CONSTRUCTION_SECONDS, color="#555555", linestyle="--", label="paper, its own, mean")
        axes.axhline(
            TRAINING_SECONDS[17], color="#555555", linestyle=":", label="paper, training 2DGS, 17 views"
        )
        axes.set_ylabel("seconds from text to splats")
        legend_above(figure, axes)
    return {"sizes": pd.DataFrame(sizes), "seconds": pd.DataFrame(seconds)}


def _angles(rows: Frame, folder: Path) -> dict[str, Frame]:
    """Table 3 by protocol, and its chart."""
    rows = _of_furthest(rows)
    categories, methods = category_order(rows["category"]), method_order(rows["method"])
    tables, means = {}, {}
    for protocol in (name for name in PROTOCOLS if name in set(rows["protocol"])):
        there = rows[rows["protocol"] == protocol]
        own = there.groupby(["category", "method"])
        means[protocol] = own["read"].mean()
        tables[protocol] = _beside_paper(
            categories,
            method_order(there["method"]),
            lambda place, own=own: (
                "/".join(_angle(own.get_group(place)[c]) for c in ("found", "read"))
                if place in own.groups
                else NOTHING
            ),
            {
                name: {key: "{:.1f}/{:.1f}".format(*value) for key, value in row.items()}
                for name, row in ANGLES.items()
                if protocol == "fixed-plane"  # the paper's
            },
        )
    series = {
        protocol: _series(
            categories, methods, mean, {c: {k: v[1] for k, v in row.items()} for c, row in ANGLES.items()}
        )
        for protocol, mean in means.items()
    }
    _panels(folder / "angles.svg", categories, series, "largest tilt that is read, degrees")
    return tables


def _of_furthest(rows: Frame) -> Frame:
    """Rows of the detector with the furthest limit for each method."""
    places = {name: place for names in _FURTHEST.values() for place, name in enumerate(names)}
    place = rows["reader"].map(places)
    each = place.groupby([rows["protocol"], rows["category"], rows["method"]])
    return rows[place == each.transform("min")]


def _angle(values: Row) -> str:
    there = values.dropna()
    if there.empty:
        return "never"
    never = len(values) - len(there)
    return f"{there.mean():.1f}" + (f" ({never} of {len(values)} never)" if never else "")


def _views(rows: Frame, folder: Path) -> dict:
    """Table 4 against ground truth of display values and of linear light, and its chart."""
    categories = category_order(rows["category"])
    there = set(rows["truth"])
    shown = [name for names in _SHOWN_TRUTHS if (name := next((n for n in names if n in there), ""))]
    tables, series = {}, {}
    for truth in shown:
        own = rows[rows["truth"] == truth]
        methods = method_order(own["method"])
        mean = own.groupby(["category", "method"])[["psnr", "ssim"]].mean()

        def cell(place: tuple[str, str], mean: Frame = mean) -> str:
            if place not in mean.index:
                return NOTHING
            return f"{fixed(mean['psnr'][place], 1)}/{fixed(mean['ssim'][place], 3)}"

        paper = {
            name: {key: f"{value[0]:.1f}/{value[1]:.2f}" for key, value in row.items()}
            for name, row in VIEWS.items()
            if truth in LINEAR  # as the paper's, which is Blender's
        }
        tables[truth] = {"title": TRUTHS[truth], "rows": _beside_paper(categories, methods, cell, paper)}
        # in linear light what blends linear light
        ending = "/light" if truth in LINEAR else "/best"
        drawn = [method for method in methods if "/" not in method or method.endswith(ending)]
        psnr = {c: {k: v[0] for k, v in row.items()} for c, row in VIEWS.items()}
        title = f"mixtures drawn as `{ending[1:]}` against\n{TRUTHS[truth]}"
        series[title] = _series(categories, drawn, mean["psnr"], psnr)
    _panels(folder / "psnr.svg", categories, series, "PSNR, dB")
    measured = {name: int(rows[name].notna().sum()) for name in ("flip", "lpips")}
    return {"tables": tables, "views": int(rows["amount"].max()), "rows": len(rows), "measured": measured}


def _trained(rows: Frame, seen: Frame | None, scans: Frame | None) -> dict:
    """The paper's baseline: a row for each category and number of views, the paper's figures beside ours of
    the first seed; other seeds say how far a PSNR is chance."""
    table, trainings, every = [], len(rows), rows
    rows = every[every["seed"] == 0]
    read = {} if scans is None else _read_of(scans)
    flips = {} if seen is None else _flips(seen)
    for category in category_order(rows["category"]):
        for count in sorted(set(rows["views"])):
            own = rows[(rows["category"] == category) & (rows["views"] == count)]
            if own.empty:
                continue
            theirs = ANGLES.get(category, {}).get(count)
            ratio, similar, _ = VIEWS[category][count]
            method = f"2dgs-{count}"
            table.append(
                {
                    "marker, views": f"{CATEGORIES[category].title}, {count}",
                    "markers": own["marker"].nunique(),
                    "PSNR/SSIM, paper": f"{ratio:.1f}/{similar:.2f}",
                    "ours": f"{own['psnr'].mean():.1f}/{own['ssim'].mean():.3f}",
                    "FLIP": flips.get((category, method), NOTHING),
                    "read to, paper": NOTHING if theirs is None else f"{theirs[1]:.1f}",
                    "read to, ours": read.get((category, method), NOTHING),
                    "read to, training-free": read.get((category, "exact/best"), NOTHING),
                    "splats": fixed(own["splats"].mean(), 0),
                    "seconds, paper": f"{TRAINING_SECONDS[count]:.0f}",
                    "seconds, several at once": fixed(own["seconds"].median(), 1),
                }
            )
    found: dict = {"rows": pd.DataFrame(table), "trainings": trainings, "markers": ""}
    found["iterations"] = int(every["amount"].max())
    if len(numbers := set(found["rows"]["markers"])) == 1:  # that needs no column
        found["markers"] = f", {numbers.pop()} of each"
        found["rows"] = found["rows"].drop(columns="markers")
    unread = "" if scans is None else _unread(rows, scans)
    return found | {"spread": _spread(every), "unread": unread, "enough": _enough(found["rows"])}


def _unread(rows: Frame, scans: Frame) -> str:
    """Categories and numbers of views with trainings that the detectors did not read."""
    markers, lacking = ["category", "views", "marker"], {}
    scans = scans.assign(views=pd.to_numeric(scans["method"].str.extract(r"^2dgs-(\d+)$")[0]))
    shown = set(scans[markers].itertuples(index=False, name=None))
    for category, count, marker in sorted(rows[markers].itertuples(index=False, name=None)):
        if (category, count, marker) not in shown:
            lacking.setdefault(category, {})[str(count)] = None
    return "; ".join(f"{CATEGORIES[c].title}, {', '.join(lacking[c])}" for c in category_order(lacking))


def _spread(rows: Frame) -> dict | None:
    """How far apart the PSNR of a marker is that was trained by several seeds; None where none was."""
    each = rows.groupby(["category", "views", "marker"])["psnr"].agg(["size", "min", "max"])
    several = each[each["size"] > 1]
    if several.empty:
        return None
    apart = several["max"] - several["min"]
    kinds = {category: [] for category in category_order(several.index.get_level_values("category"))}
    for category, count, _ in several.index:
        kinds[category].append(count)
    named = ", ".join(
        f"{CATEGORIES[category].title} on {', '.join(map(str, sorted(set(counts))))} views"
        for category, counts in kinds.items()
    )
    most = int(several["size"].max())
    return {"of": named, "seeds": most, "median": float(apart.median()), "most": float(apart.max())}


def _enough(table: Frame) -> list[dict]:
    """Per category, the fewest training views after which a marker is read to the same tilt as the
    training-free one; if there are none, the views with the smallest difference in degrees, `before`."""
    ours, free, seconds = (
        pd.Series(pd.to_numeric(table[name], errors="coerce"))
        for name in ("read to, ours", "read to, training-free", "seconds, several at once")
    )
    kinds = table["marker, views"].str.rpartition(", ")
    rows = {"marker": kinds[0], "views": kinds[2], "before": (free - ours).clip(lower=0), "seconds": seconds}
    ordered = pd.DataFrame(rows).dropna(subset=["before"]).sort_values("before", kind="stable")
    return ordered.drop_duplicates("marker").sort_index().to_dict("records")


def _flips(seen: Frame) -> dict[tuple[str, str], str]:
    """FLIP of novel views against the ground truth of training, by category and method."""
    means = seen[seen["truth"] == "exact"].groupby(["category", "method"])["flip"].mean()
    return {place: fixed(mean, 3) for place, mean in means.items()}


def _read_of(scans: Frame) -> dict[tuple[str, str], str]:
    """Largest readable tilt on the paper's plane, by category and method."""
    scans = _of_furthest(scans[scans["protocol"] == "fixed-plane"])
    return {place: _angle(own["read"]) for place, own in scans.groupby(["category", "method"])}


def _localisation(rows: Frame, folder: Path) -> Frame:
    """Median position error by every other distance, and number of views read."""
    methods = method_order(rows["method"])
    rows = rows[rows["distance_m"].isin(sorted(set(rows["distance_m"]))[::2])]
    table = []
    for (category, distance), own in rows.groupby(["category", "distance_m"]):
        row = {"marker, distance": f"{CATEGORIES[str(category)].title}, {distance:g} m"}
        for method in methods:
            one = own[own["method"] == method]
            read, seen = one["read"].sum(), one["amount"].sum()
            lost = f" ({read}/{seen})" if read < seen else ""
            row[method] = (number(one["position_mm"].median()) if read else "not read") + (
                lost if read else ""
            )
        table.append(row)
    return pd.DataFrame(table)


def _beside_paper(
    categories: Sequence[str],
    methods: Sequence[str],
    cell: Callable[[tuple[str, str]], str],
    paper: dict[str, dict],
) -> Frame:
    """Rows by category: figures of the paper if any, then ours."""
    theirs = {PAPER: "ours", TRAINED: 17} if paper else {}
    return pd.DataFrame(
        [
            {"category": CATEGORIES[category].title}
            | {words: paper.get(category, {}).get(key, NOTHING) for words, key in theirs.items()}
            | {method: cell((category, method)) for method in methods}
            for category in categories
        ]
    )


def _series(
    categories: Sequence[str], methods: Sequence[str], values: Row, paper: dict[str, dict]
) -> dict[str, list[float]]:
    """Our figures by method, then the paper's, for `_panels`."""
    nan = float("nan")
    own = {_short(m): [values.get((c, m), nan) for c in categories] for m in methods}
    theirs = {
        words: [paper.get(c, {}).get(key, nan) for c in categories]
        for words, key in ((PAPER, "ours"), (TRAINED, 17))
    }
    return own | theirs


def _short(method: str) -> str:
    """Name of a method in charts, without its filter."""
    mixture, slash, _ = method.partition("/")
    return f"mixture {mixture}" if slash else method


def _panels(
    file: Path, categories: Sequence[str], panels: dict[str, dict[str, list[float]]], unit: str
) -> None:
    """Panels of bars by category with one legend."""
    names = list(dict.fromkeys(name for series in panels.values() for name in series))
    names.sort(key=lambda name: (name in (PAPER, TRAINED), name != IDEAL))
    nothing = [float("nan")] * len(categories)
    with chart(file, len(panels), (4.5 * len(panels) + 2, 4.2)) as (figure, axes):
        for one, (title, series) in zip(axes, panels.items(), strict=True):
            bars(one, _titles(categories), {name: series.get(name, nothing) for name in names})
            one.set_title(title)
            one.tick_params(axis="x", labelsize=8)
        axes[0].set_ylabel(unit)
        legend_above(figure, axes[0])
