"""Measures how frames grow with splats, pixels and overdraw, into a file of JSON lines.

    python benchmarks/growth.py growth.jsonl --device opencl
    python benchmarks/growth.py growth.jsonl more.jsonl --plot docs/images       plots what was measured

A plot for each series, log-log, a panel for each device (`pip install '.[bench]'`): whole frames are bold,
stages thin; titles give the exponent of the frame's upper half.

A series ends when a frame takes longer than --longest, or when the device cannot hold the scene. Each point
is written when it is done; a run that was stopped goes on where it was when it is given the same file.
"""

from __future__ import annotations

import json
from pathlib import Path

from measuring import PROGRESS, keep, options, show
from rich.progress import Progress, TextColumn

import fidsplat as fs
from fidsplat.backends.base import Measurable
from fidsplat.experiments.bench.growth import Point, abscissa, exponents, measure, points
from fidsplat.files import atomic_write


def read(file: Path) -> list[dict]:
    """Records that a file holds; a last line that was cut off is left out."""
    records = []
    for line in file.read_text("utf-8").splitlines() if file.exists() else ():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return records


def run(series: dict[str, list[Point]], device: str, repeats: int, longest: float, file: Path) -> list[dict]:
    """Measure what the file does not have yet; returns all of it."""
    records = read(file)
    file.write_text("".join(json.dumps(record) + "\n" for record in records), "utf-8")
    renderer = fs.Renderer(device)
    title = renderer.device.title
    rates = renderer.backend.rates() if isinstance(renderer.backend, Measurable) else None
    del renderer
    known = {(record["title"], record["series"], record["x"]): record for record in records}
    columns = (*Progress.get_default_columns(), TextColumn("{task.fields[now]}"))
    with Progress(*columns, console=PROGRESS) as progress:
        task = progress.add_task("points", total=sum(map(len, series.values())), now="")
        for row in series.values():
            for number, point in enumerate(row):
                progress.update(task, now=f"{point.series} {point.x:g}")
                record = known.get((title, point.series, point.x))
                if record is None:
                    record = measure(point, device, rates, repeats)
                    records.append(record)
                    with file.open("a", encoding="utf-8") as stream:
                        stream.write(json.dumps(record) + "\n")
                progress.advance(task)
                if record["error"] or record["fastest_ms"] > 1e3 * longest:
                    why = record["error"] or f"a frame takes {record['fastest_ms'] / 1e3:.1f} s"
                    progress.console.print(f"{point.series} ends at {point.x:g}: {why}", markup=False)
                    progress.advance(task, len(row) - number - 1)
                    break
    return records


STAGES = ("project", "sort", "bin", "blend", "resolve")
UNITS = {"splats": "splats", "pixels": "pixels", "overdraw": "splats over a pixel, seen or hidden"}
TITLES = {
    "splats": "1920 x 1080, the same covered area",
    "pixels": "a million splats",
    "overdraw": "300,000 splats of growing size, 1920 x 1080",
}


def plot(series: str, records: list[dict], file: Path) -> None:
    """One series: a panel for each device, all of one scale."""
    from matplotlib import pyplot as plt

    plt.switch_backend("agg")
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
    parser = options(__doc__, repeats=10)
    parser.add_argument("files", nargs="+", type=Path, help="JSON lines; what is there is not measured again")
    parser.add_argument("--longest", type=float, default=2.0, metavar="S", help="seconds (default: 2)")
    parser.add_argument("--plot", type=Path, metavar="DIR", help="measure nothing; plot what the files hold")
    asked = parser.parse_args()
    if asked.plot is not None:
        records = [record for file in asked.files for record in read(file)]
        for series in dict.fromkeys(record["series"] for record in records):
            plot(series, records, asked.plot / f"growth-{series}.png")
        return
    try:
        records = run(points(), asked.device, max(asked.repeats, 1), asked.longest, asked.files[0])
    except KeyboardInterrupt:
        raise SystemExit(f"growth: stopped; {asked.files[0]} holds what was measured") from None
    if keep(records, asked.json):
        return
    stages = list(dict.fromkeys(stage for record in records for stage in record.get("stages_ms", ())))
    rows = []
    for title, series, found in exponents(records):
        cells = (found.get(name) for name in ("frame", *stages))
        rows.append((title, series, *("-" if cell is None else f"{cell:.2f}" for cell in cells)))
    heads = ("device", "over", "frame", *stages)
    show("Exponents over the upper half of each series", heads, rows)


if __name__ == "__main__":
    main()
