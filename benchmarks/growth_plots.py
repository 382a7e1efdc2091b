"""Draws what benchmarks/growth.py measured: a picture for each series, log-log, a panel for each device.

    pip install '.[bench]'
    python benchmarks/growth_plots.py growth-cpu.jsonl growth-gpu.jsonl -o docs/images

Writes growth-splats.png, growth-pixels.png and growth-overdraw.png. Whole frames are bold, stages thin;
titles give the exponent of the frame's upper half.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("agg")
from growth import read
from matplotlib import pyplot as plt

from fidsplat.experiments.bench.growth import abscissa, exponents
from fidsplat.files import atomic_write

STAGES = ("project", "sort", "bin", "blend", "resolve")
UNITS = {"splats": "splats", "pixels": "pixels", "overdraw": "splats over a pixel, seen or hidden"}
TITLES = {
    "splats": "1920 x 1080, the same covered area",
    "pixels": "a million splats",
    "overdraw": "300,000 splats of growing size, 1920 x 1080",
}


def plot(series: str, records: list[dict], file: Path) -> None:
    """One series: a panel for each device, all of one scale."""
    chosen = [record for record in records if record["series"] == series and "frame_ms" in record]
    titles = list(dict.fromkeys(record["title"] for record in chosen))
    slopes = {title: found["frame"] for title, name, found in exponents(chosen) if name == series}
    figure, panels = plt.subplots(
        1,
        len(titles),
        figsize=(4.2 * len(titles) + 0.9, 4),
        dpi=110,
        layout="constrained",
        sharey=True,
        squeeze=False,
    )
    lines: dict = {}
    for axes, title in zip(panels[0], titles, strict=True):
        own = sorted((record for record in chosen if record["title"] == title), key=abscissa)
        over, slope = [abscissa(record) for record in own], slopes[title]
        (lines["frame"],) = axes.loglog(over, [r["fastest_ms"] for r in own], "k", marker="o", lw=2, ms=4)
        for number, stage in enumerate(STAGES):
            times = [record["fastest_stages_ms"].get(stage) for record in own]
            (lines[stage],) = axes.loglog(over, times, color=f"C{number}", lw=1.2, marker=".", ms=5)
        grows = "" if slope is None else f"\nframe grows as x^{slope:.2f}"
        axes.set_title(f"{title}{grows}", fontsize=10)
        axes.set_xlabel(UNITS[series])
        axes.grid(which="major", alpha=0.3, lw=0.5)
    panels[0, 0].set_ylabel("ms, fastest of the repeats")
    figure.suptitle(TITLES[series], fontsize=11)
    figure.legend(lines.values(), lines.keys(), loc="outside right center", frameon=False)
    with atomic_write(file) as stream:
        figure.savefig(stream, format="png", metadata={"Software": None})
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    records = [record for file in options.files for record in read(file)]
    if not records:
        raise SystemExit("growth_plots: these files hold no records")
    for series in dict.fromkeys(record["series"] for record in records):
        file = options.out / f"growth-{series}.png"
        plot(series, records, file)
        print(file)


if __name__ == "__main__":
    main()
