"""Curves of docs/large-scenes.md: splats of a store against time, error, splats that are drawn, and memory.

    python benchmarks/store_curves.py benchmarks/results/stores-cpu.json docs/images/store-curves.svg

Takes what `benchmarks/store_views.py --json` has written: a point for each size of a scene, a colour for each
view, a dash for the default quality and for each allowed error. A line that several have is drawn once.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

from fidsplat.experiments.charts import COLOURS, chart, legend_above, plain_ticks

PANELS = (
    ("next view [ms]", lambda row: 1e3 * row["s"][1]),
    ("largest error of rgb", lambda row: row.get("off", math.nan)),
    ("splats read [million]", lambda row: row["drawn"] / 1e6),
    ("device memory [GiB]", lambda row: row["device_bytes"] / 2**30),
)
SHARED = "several of these alike"
DASHES = ("-", "--", ":", "-.")

Series = dict[tuple[str, str], list[dict]]


def series(rows: list[dict]) -> Series:
    """Rows that were drawn, by view and quality, in the order of their scenes' sizes."""
    found: Series = {}
    for row in sorted(rows, key=lambda row: row["splats"]):
        error = row["error"]
        quality = "default quality" if error == "standard" else f"error {error:.2g}" if error else "exact"
        if "s" in row:
            found.setdefault((row["view"], quality), []).append(row)
    return found


def lines(found: Series, value) -> dict[tuple[tuple[float, float], ...], list[tuple[str, str]]]:
    """Lines of (splats in million, value), each with the views and qualities that have it."""
    owners: dict[tuple[tuple[float, float], ...], list[tuple[str, str]]] = {}
    for name, rows in found.items():
        line = tuple((row["splats"] / 1e6, value(row)) for row in rows)
        owners.setdefault(line, []).append(name)
    return owners


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("out", type=Path)
    asked = parser.parse_args()
    found = series(json.loads(asked.results.read_text())["rows"])
    views, qualities = (list(dict.fromkeys(names)) for names in zip(*found, strict=True))
    colours = dict(zip((SHARED, *views), COLOURS, strict=False))
    dashes = dict(zip(qualities, DASHES, strict=True))
    with chart(asked.out, len(PANELS), (15.0, 4.6), one_scale=False) as (figure, panels):
        for view in (*views, SHARED):
            panels[0].plot([], [], ".-", color=colours[view], label=view)
        for quality in qualities:
            panels[0].plot([], [], dashes[quality], color="black", label=quality)
        for axes, (title, value) in zip(panels, PANELS, strict=True):
            for line, owners in lines(found, value).items():
                view, quality = owners[0]
                alike = len(owners) > 1
                axes.plot(
                    *zip(*line, strict=True),
                    marker=".",
                    color=colours[SHARED if alike else view],
                    linestyle="-" if alike else dashes[quality],
                )
            axes.set(xscale="log", xlabel="splats of the scene [million]", title=title)
            plain_ticks(axes.xaxis)
            if "error" not in title:  # which may be 0
                axes.set_yscale("log")
                plain_ticks(axes.yaxis)
        legend_above(figure, panels[0])


if __name__ == "__main__":
    main()
