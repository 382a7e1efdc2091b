"""Accuracy of localisation from results."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from fidsplat.experiments.charts import bar_chart
from fidsplat.experiments.document import Document
from fidsplat.experiments.figures import NOTHING, bar, category_order, full_or_quick, method_order
from fidsplat.experiments.setup import CATEGORIES


def report_localisation(document: Document, lines: Sequence[dict]) -> dict[str, str]:
    """Add the tables of pose errors; returns charts, file name -> SVG."""
    chosen = full_or_quick(lines, _size)
    document.heading("Accuracy of localisation")
    document.text(
        "Errors of poses from codes of 0.16 m, 1280 x 720, 60 degrees: position in mm / angle in degrees / "
        "corners in pixels (root mean square), medians over the markers; in brackets how many of them were "
        "read where not all were. The same cameras for every method."
    )
    charts = {}
    methods = method_order({key[2] for key in chosen})
    for category in category_order({key[0] for key in chosen}):
        document.heading(CATEGORIES[category].title, 3)
        views: dict[tuple[float, float, str], list[dict]] = {}
        for (name, _, method), line in chosen.items():
            if name == category:
                for view in line["result"]["views"]:
                    views.setdefault((view["distance_m"], view["tilt_deg"], method), []).append(view)
        places = sorted({key[:2] for key in views})
        rows = [
            (f"{distance:g} m, {tilt:g} deg", *(_cell(views.get((distance, tilt, m), [])) for m in methods))
            for distance, tilt in places
        ]
        document.table(("distance, tilt", *methods), rows)
        distances = sorted({distance for distance, _ in places})
        series = {
            method: [
                bar(
                    [
                        v["position_mm"]
                        for (d, _, m), seen in views.items()
                        if (d, m) == (x, method)
                        for v in seen
                    ]
                )
                for x in distances
            ]
            for method in methods
        }
        shown = {name: row for name, row in series.items() if any(row)}
        if shown:
            file = f"localisation-{category}.svg"
            title = f"{CATEGORIES[category].title}: error of position, mean over tilts and markers where read"
            charts[file] = bar_chart(title, "mm", [f"{x:g} m" for x in distances], shown)
            document.picture(file, title)
    return charts


def _size(line: dict) -> tuple[tuple, float]:
    key = line["key"]
    return (key["category"], key["index"], key["method"]), len(key["distances"]) * len(key["tilts"])


def _cell(seen: list[dict]) -> str:
    read = [view for view in seen if view["position_mm"] is not None]
    if not read:
        return "not read" if seen else NOTHING
    columns = (("position_mm", 3), ("angle_deg", 3), ("corners_px", 3))
    text = " / ".join(f"{statistics.median(view[n] for view in read):.{digits}f}" for n, digits in columns)
    return text if len(read) == len(seen) else f"{text} ({len(read)} of {len(seen)})"
