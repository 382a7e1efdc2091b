"""Table 4 from results."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from fidsplat.experiments.charts import bar_chart
from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING, bar, category_order, full_or_quick, method_order
from fidsplat.experiments.methods import IDEAL
from fidsplat.experiments.paper import VIEWS
from fidsplat.experiments.setup import CATEGORIES, COLLECTIONS
from fidsplat.experiments.views import TRUTHS


class Views:
    """Metrics of each marker, mean over its views, by what they are of.

    Args:
        lines: of `views.jsonl`.
    """

    def __init__(self, lines: Sequence[dict]) -> None:
        self.views: set[int] = set()
        self.found: dict[tuple[str, str, str], dict[int, dict[str, float | None]]] = {}
        for (truth, category, method, index), line in full_or_quick(lines, _size).items():
            means = {
                name: None
                if values is None or all(v is None for v in values)
                else statistics.fmean(v for v in values if v is not None)
                for name, values in line["result"].items()
            }
            self.found.setdefault((truth, category, method), {})[index] = means
            self.views.add(line["key"]["views"])

    def names(self, place: int) -> set[str]:
        """What occurs: 0 truths, 1 categories, 2 methods."""
        return {key[place] for key in self.found}

    def values(self, truth: str, category: str, method: str, metric: str) -> list[float | None]:
        """Of each marker."""
        markers = self.found.get((truth, category, method), {})
        return [means[metric] for _, means in sorted(markers.items())]

    def mean(self, truth: str, category: str, method: str, metric: str) -> float | None:
        """Over the markers."""
        there = [v for v in self.values(truth, category, method, metric) if v is not None]
        return statistics.fmean(there) if there else None


def _size(line: dict) -> tuple[tuple, float]:
    key = line["key"]
    # of equally many views, the line with more metrics
    amount = key["views"] + 0.1 * bool(key["flip"]) + 0.2 * bool(key["lpips"])
    return (key["truth"], key["category"], key["method"], key["index"]), amount


def report_views(document: Document, lines: Sequence[dict]) -> dict[str, str]:
    """Add table 4; returns charts, file name -> SVG."""
    views = Views(lines)
    document.heading("Table 4: novel views")
    counted = {len(markers) for markers in views.found.values()}
    document.text(
        f"PSNR in dB / SSIM / LPIPS / FLIP, mean over {_list(views.views)} random views of each marker and "
        f"over {_list(counted)} markers of each category, 800 x 800, whole frame, 8 bits."
        + _not_measured(views)
    )
    charts = {}
    for truth in (name for name in TRUTHS if name in views.names(0)):
        document.heading(f"Against {truth}: {TRUTHS[truth]}", 3)
        there = {method for t, _, method in views.found if t == truth}
        methods = [m for m in method_order(there | {IDEAL}) if not m.startswith("2dgs-")]
        rows = []
        categories = category_order(views.names(1))
        for category in categories:
            paper = VIEWS[category]
            cells = [_cell(views, truth, category, method) for method in methods]
            theirs = [
                f"{_cell(views, truth, category, f'2dgs-{n}')} (paper {_paper(paper[n])})"
                for n in COLLECTIONS
            ]
            rows.append((CATEGORIES[category].title, _paper(paper["ours"]), *cells, *theirs))
        heads = ("category", "paper, its own", *methods, *(f"2DGS, {n} views" for n in COLLECTIONS))
        document.table(heads, rows)
        series = {
            method: [bar(views.values(truth, category, method, "psnr")) for category in categories]
            for method in methods
        }
        series["paper, its own"] = [bar([VIEWS[c]["ours"][0]]) for c in categories]
        titles = [CATEGORIES[name].title for name in categories]
        shown = {name: row for name, row in series.items() if any(row)}
        charts[f"psnr-{truth}.svg"] = bar_chart(f"PSNR against {truth}", "dB", titles, shown)
        document.picture(f"psnr-{truth}.svg", f"PSNR against {truth}")
    if "exact-linear" in views.names(0):
        document.text(
            "The ideal against exact-linear is what a picture that is perfect in display values loses when "
            "the truth takes its means in linear light, as Blender's 'Standard' view does: the difference "
            "sits on module edges, so it grows with the number of modules. A renderer that blends display "
            "values, as splat renderers do, comes no closer to such a truth, but by luck. The rows /light "
            "blend linear light and encode it as the last step (the sensor's response srgb)."
        )
    return charts


def _not_measured(views: Views) -> str:
    """What the columns of metrics lack, and what would fill them."""
    needs = {
        "lpips": "weights, which the user supplies (--lpips FILE.npz)",
        "flip": "flip-evaluator (pip install 'fidsplat[experiments]')",
    }
    every = [means for markers in views.found.values() for means in markers.values()]
    words = ""
    for metric, need in needs.items():
        there = sum(means[metric] is not None for means in every)
        if there < len(every):
            share = "not" if there == 0 else f"in {there} of {len(every)} parts"
            words += f" {metric.upper()} was {share} measured ('-' where not): it needs {need}."
    return words


def _cell(views: Views, truth: str, category: str, method: str) -> str:
    if (truth, category, method) not in views.found:
        return "equal" if method == IDEAL else NOTHING
    digits = (("psnr", 2), ("ssim", 3), ("lpips", 3), ("flip", 3))
    values = ((views.mean(truth, category, method, name), places) for name, places in digits)
    return " / ".join(NOTHING if value is None else f"{value:.{places}f}" for value, places in values)


def _paper(values: tuple[float, float, float]) -> str:
    return "{:.2f} / {:.2f} / {:.2f}".format(*values)


def _list(numbers: set[int]) -> str:
    return " or ".join(map(str, sorted(numbers)))
