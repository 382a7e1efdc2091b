"""Curves of docs/large-scenes.md: splats of a store against time, splats that are drawn, and memory.

    python benchmarks/store_curves.py benchmarks/results/stores-h100.json docs/images/store-curves.svg

Takes what `benchmarks/store_views.py --json` has written: a point for each size of a scene, a line for each
view at the default quality and at each allowed error.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from fidsplat.experiments.charts import chart, legend_above, plain_ticks

PANELS = (
    ("next view [ms]", lambda row: 1e3 * row["s"][1]),
    ("splats read [million]", lambda row: row["drawn"] / 1e6),
    ("device memory [GiB]", lambda row: row["device_bytes"] / 2**30),
)


def series(rows: list[dict]) -> dict[str, list[dict]]:
    """Rows that were drawn, by view and error, in the order of their scenes' sizes."""
    found: dict[str, list[dict]] = {}
    for row in sorted(rows, key=lambda row: row["splats"]):
        error = row["error"]
        allowed = "default quality" if error == "standard" else f"error {error:g}" if error else "exact"
        if "s" in row:
            found.setdefault(f"{row['view']}, {allowed}", []).append(row)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("results", type=Path)
    parser.add_argument("out", type=Path)
    asked = parser.parse_args()
    found = series(json.loads(asked.results.read_text())["rows"])
    with chart(asked.out, len(PANELS), (12.0, 4.6), one_scale=False) as (figure, panels):
        for axes, (title, value) in zip(panels, PANELS, strict=True):
            for name, rows in found.items():
                sizes = [row["splats"] / 1e6 for row in rows]
                axes.plot(sizes, [value(row) for row in rows], ".-", label=name)
            axes.set(xscale="log", yscale="log", xlabel="splats of the scene [million]", title=title)
            plain_ticks(axes.xaxis)
            plain_ticks(axes.yaxis)
        legend_above(figure, panels[0])


if __name__ == "__main__":
    main()
