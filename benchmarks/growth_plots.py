"""Draws what benchmarks/growth.py measured: a picture for each series, log-log, a line for each device.

    pip install '.[bench]'
    python benchmarks/growth_plots.py growth-cpu.jsonl growth-gpu.jsonl -o docs/images

Writes growth-splats.png, growth-pixels.png and growth-overdraw.png. Whole frames are bold, stages thin;
legends give the exponent of the frame's upper half.
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

UNITS = {"splats": "splats", "pixels": "pixels", "overdraw": "splats over a pixel, seen or hidden"}
TITLES = {
    "splats": "1920 x 1080, the same covered area",
    "pixels": "a million splats",
    "overdraw": "300,000 splats of growing size, 1920 x 1080",
}


def plot(series: str, records: list[dict], file: Path) -> None:
    """One series of every device in one picture."""
    chosen = [record for record in records if record["series"] == series and "frame_ms" in record]
    figure, axes = plt.subplots(figsize=(6.4, 4.4), dpi=110, layout="constrained")
    slopes = {title: found["frame"] for title, name, found in exponents(chosen) if name == series}
    styles = {}
    for number, title in enumerate(dict.fromkeys(record["title"] for record in chosen)):
        own = sorted((record for record in chosen if record["title"] == title), key=abscissa)
        over, dashes = [abscissa(record) for record in own], ("-", "--", ":", "-.")[number % 4]
        slope = slopes[title]
        words = title if slope is None else f"{title}: frame ~ x^{slope:.2f}"
        axes.loglog(over, [r["fastest_ms"] for r in own], f"k{dashes}", marker="o", lw=2, ms=4, label=words)
        for stage in own[0]["fastest_stages_ms"]:
            color = styles.setdefault(stage, f"C{len(styles)}")
            times = [record["fastest_stages_ms"].get(stage) for record in own]
            label = stage if number == 0 else None
            axes.loglog(over, times, color=color, ls=dashes, lw=1, marker=".", ms=4, label=label)
    axes.set(xlabel=UNITS[series], ylabel="ms, fastest of the repeats", title=TITLES[series])
    axes.grid(which="both", alpha=0.25, lw=0.5)
    axes.legend(fontsize=8)
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
