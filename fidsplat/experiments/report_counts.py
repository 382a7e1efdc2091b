"""Table 2 and the figure of counts from results."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from fidsplat.experiments.charts import Bar, bar_chart
from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING, bar, category_order, full_or_quick, mean_spread
from fidsplat.experiments.methods import mixtures
from fidsplat.experiments.paper import CONSTRUCTION_SECONDS, TRAINING_SECONDS
from fidsplat.experiments.setup import CATEGORIES

_PARTITIONS = {"cells": "squares", "runs": "row runs", "rectangles": "minimum partition"}


class Counts:
    """Results of each category's markers.

    Args:
        lines: of `counts.jsonl`.
    """

    def __init__(self, lines: Sequence[dict]) -> None:
        chosen = full_or_quick(lines, _size)
        self.markers: dict[str, list[dict]] = {}
        for (category, _), line in sorted(chosen.items()):
            self.markers.setdefault(category, []).append(line["result"])
        there = {name for results in self.markers.values() for r in results for name in r["gaussians"]}
        self.mixtures = [name for name in mixtures() if name in there]

    def seconds(self, category: str, mixture: str) -> list[float]:
        """Median seconds of each marker."""
        return [statistics.median(r["seconds"][mixture]) for r in self.markers[category]]

    def all_seconds(self, category: str, mixture: str) -> list[float]:
        """Every repeat of every marker."""
        return [value for r in self.markers[category] for value in r["seconds"][mixture]]

    def gaussians(self, category: str, mixture: str, partition: str = "rectangles") -> list[int | None]:
        """Of each marker."""
        return [r["gaussians"][mixture].get(partition) for r in self.markers[category]]

    def rectangles(self, category: str, partition: str = "rectangles") -> list[int]:
        """Of each marker, both colours."""
        return [r[partition]["dark"] + r[partition]["light"] for r in self.markers[category]]


def _size(line: dict) -> tuple[tuple, float]:
    key = line["key"]
    return (key["category"], key["index"]), key["repeats"]


def report_counts(document: Document, lines: Sequence[dict]) -> dict[str, str]:
    """Add tables 1 and 2 and the figure; returns charts, file name -> SVG."""
    counts = Counts(lines)
    categories = category_order(counts.markers)
    _sizes(document, categories)
    _seconds(document, counts, categories)
    document.heading("Figure: primitives of each category")
    document.text("Dark + light, mean over the markers; light with the quiet zone (1 module, QR 4).")
    heads = ("category", "components", *(f"rectangles, {title}" for title in _PARTITIONS.values()))
    document.table(
        heads,
        [
            (CATEGORIES[c].title, *(_dark_light(counts, c, n) for n in ("components", *_PARTITIONS)))
            for c in categories
        ],
    )
    heads = ("category", *(f"{m}, {t}" for m in counts.mixtures for t in _PARTITIONS.values()))
    rows = [
        (
            CATEGORIES[c].title,
            *(mean_spread(counts.gaussians(c, m, p), 0) for m in counts.mixtures for p in _PARTITIONS),
        )
        for c in categories
    ]
    document.text("Gaussians by mixture and partition, mean ± standard deviation.")
    document.table(heads, rows)
    series: dict[str, list[Bar | None]] = {
        f"{m}, {_PARTITIONS[p]}": [bar(counts.gaussians(c, m, p)) for c in categories]
        for m in counts.mixtures
        for p in ("runs", "rectangles")
    }
    series |= {"rectangles": [bar([float(n) for n in counts.rectangles(c)]) for c in categories]}
    titles = [CATEGORIES[c].title for c in categories]
    shown = {name: row for name, row in series.items() if any(row)}
    document.picture("counts.svg", "Primitives of each category")
    return {"counts.svg": bar_chart("Primitives of a marker", "number", titles, shown, logarithmic=True)}


def _sizes(document: Document, categories: list[str]) -> None:
    document.heading("Table 1: QR codes")
    rows = []
    for name in categories:
        category = CATEGORIES[name]
        if category.version is not None:
            side = 17 + 4 * category.version
            rows.append((category.title, str(category.length), str(category.version), f"{side} x {side}"))
    document.table(("category", "string length", "QR version", "modules"), rows)


def _seconds(document: Document, counts: Counts, categories: list[str]) -> None:
    document.heading("Table 2: seconds from the text to the splats")
    rows = [
        (CATEGORIES[c].title, *(mean_spread(counts.all_seconds(c, m), 4) for m in counts.mixtures))
        for c in categories
    ]
    every = [mean_spread([s for c in categories for s in counts.seconds(c, m)], 4) for m in counts.mixtures]
    rows.append(("all, mean of medians", *every))
    rows.append(("paper, its own, all", *[f"{CONSTRUCTION_SECONDS:.2f}"] * len(counts.mixtures)))
    document.text(
        "Mean ± standard deviation over all repeats, one process, imports done. The paper trains 2DGS in "
        + ", ".join(f"{s:.0f} s ({n} views)" for n, s in TRAINING_SECONDS.items())
        + "."
    )
    document.table(("category", *counts.mixtures), rows)


def _dark_light(counts: Counts, category: str, name: str) -> str:
    results = counts.markers[category]
    if not results:
        return NOTHING
    dark, light = (statistics.fmean(r[name][colour] for r in results) for colour in ("dark", "light"))
    return f"{dark:.1f} + {light:.1f}"
