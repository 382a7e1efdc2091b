"""Measure frame times against splats, pixels and overdraw, as JSON lines.

    python benchmarks/growth.py growth.jsonl --device opencl
    python benchmarks/growth.py growth.jsonl more.jsonl --plot docs/images       plots measurements

--plot writes a log-log chart for each series with a panel for each device (`pip install '.[bench]'`): bold
lines for complete frames, thin lines for stages, and the exponent of the upper half of the curve.

A series ends when a frame takes longer than --longest, or when the scene does not fit on the device. Each
point is written immediately; an interrupted run resumes with the same file
(fidsplat/experiments/sweep.py).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from measuring import PROGRESS, keep, options, show
from rich.progress import Progress, TextColumn
from tables import exponent

import fidsplat as fs
from fidsplat.backends.interface import Rates
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.experiments.bench.measure import SceneRun, overdraw
from fidsplat.experiments.sweep import Results, name_of, read_records
from fidsplat.scenes.random_clouds import random_cloud, standard_camera
from fidsplat.util.files import atomic_write
from fidsplat.util.provenance import run_facts
from fidsplat.util.timing import time_interleaved

MILLION = 1_000_000


@dataclass(frozen=True)
class Point:
    """One scene of a series."""

    series: str
    x: float
    """abscissa of the series: splats, pixels, or factor of the splats' size"""
    count: int
    median_scale: float
    """metres"""
    width: int
    height: int

    def make(self) -> tuple[fs.SplatCloud, fs.Camera]:
        """The random scene, made like those of random_clouds.py."""
        return random_cloud(self.count, self.median_scale), standard_camera(self.width, self.height)


def points() -> dict[str, list[Point]]:
    """Points of every series, in increasing order.

    splats: 10^4 to 2 x 10^7 in 1080p, with sizes for the same total area. pixels: 0.25 to 8 million pixels of
    the million splats of r1m_1080p. overdraw: 300,000 splats in 1080p, with 0.5 to 8 times the size of those
    of r1m_1080p.
    """
    counts = [10_000, 30_000, 100_000, 300_000, MILLION, 3 * MILLION, 10 * MILLION, 20 * MILLION]
    over_splats = [Point("splats", n, n, 0.012 * math.sqrt(MILLION / n), 1920, 1080) for n in counts]
    over_pixels = []
    for pixels in (0.25, 0.5, 1, 2, 4, 8):
        height = round(math.sqrt(pixels * MILLION * 9 / 16) / 9) * 9
        width = height * 16 // 9
        over_pixels.append(Point("pixels", width * height, MILLION, 0.012, width, height))
    over_size = [
        Point("overdraw", factor, 300_000, 0.012 * factor, 1920, 1080) for factor in (0.5, 1, 2, 4, 8)
    ]
    return {"splats": over_splats, "pixels": over_pixels, "overdraw": over_size}


def measure(point: Point, device: str, rates: Rates | None, repeats: int) -> dict:
    """Record of a point as in `fidsplat bench --json`, with its series and x; for the series `overdraw` also
    `layers_per_pixel`, the number of fragments at a pixel, occluded ones included.

    `error` has the reason if the device cannot render the scene.
    """
    cloud, camera = point.make()
    run = SceneRun(f"{point.series} {point.x:g}", device, rates, cloud, camera)
    del cloud
    time_interleaved([run.result.timer], repeats)
    record = run.result.as_dict() | {"series": point.series, "x": point.x}
    if not record["error"]:
        del record["error"]
    if point.series == "overdraw" and "fragments" in record:
        layers = overdraw(run.renderer, run.resident, camera, TIMED.with_(transmittance_stop=0.0))
        record["layers_per_pixel"] = float(layers.mean(dtype=np.float64))
    return record


def run(series: dict[str, list[Point]], device: str, repeats: int, longest: float, file: Path) -> list[dict]:
    """Measure points that the file lacks; returns all records."""
    renderer = fs.Renderer(device)
    info, backend = renderer.device, renderer.backend
    results = Results(file, run_facts(f"{info.title}, {info.version}", 0))
    rates = backend.rates() if backend.has("rates") else None
    del renderer, backend
    columns = (*Progress.get_default_columns(), TextColumn("{task.fields[now]}"))
    with Progress(*columns, console=PROGRESS) as progress:
        task = progress.add_task("points", total=sum(map(len, series.values())), now="")
        for row in series.values():
            for number, point in enumerate(row):
                progress.update(task, now=f"{point.series} {point.x:g}")
                key = asdict(point)
                done = results.done.get(name_of(key))
                found = (done or results.append(key, measure(point, device, rates, repeats))).result
                progress.advance(task)
                if "error" in found or found["fastest_ms"] > 1e3 * longest:
                    why = found.get("error") or f"a frame takes {found['fastest_ms'] / 1e3:.1f} s"
                    progress.console.print(f"{point.series} ends at {point.x:g}: {why}", markup=False)
                    progress.advance(task, len(row) - number - 1)
                    break
    return [record.result for record in results.done.values()]


def abscissa(record: dict) -> float:
    """Abscissa of a record: x, or the layers per pixel for the series `overdraw`."""
    return record.get("layers_per_pixel", record["x"])


def exponents(records: Sequence[dict]) -> Iterator[tuple[str, str, dict[str, float | None]]]:
    """Exponents of `frame` and of each stage for each device and series, from the fastest of the repeats,
    which has the least disturbance by other processes."""
    measured = [record for record in records if not record.get("error") and "frame_ms" in record]
    for title, series in dict.fromkeys((record["title"], record["series"]) for record in measured):
        chosen = [record for record in measured if (record["title"], record["series"]) == (title, series)]
        chosen.sort(key=abscissa)
        over = [abscissa(record) for record in chosen]
        found = {"frame": exponent(over, [record["fastest_ms"] for record in chosen])}
        for stage in chosen[0]["fastest_stages_ms"]:
            times = [record["fastest_stages_ms"].get(stage, 0.0) for record in chosen]
            found[stage] = exponent(over, times)
        yield title, series, found


STAGES = ("project", "sort", "bin", "blend", "resolve")
UNITS = {"splats": "splats", "pixels": "pixels", "overdraw": "splats at a pixel, visible or occluded"}
TITLES = {
    "splats": "1920 x 1080, the same covered area",
    "pixels": "a million splats",
    "overdraw": "300,000 splats of growing size, 1920 x 1080",
}


def plot(series: str, records: list[dict], file: Path) -> None:
    """Plot a series with a panel for each device, all with the same scale."""
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
    arguments = parser.parse_args()
    if arguments.plot is not None:
        records = [record.result for file in arguments.files for record in read_records(file)]
        for series in dict.fromkeys(record["series"] for record in records):
            plot(series, records, arguments.plot / f"growth-{series}.png")
        return
    try:
        records = run(
            points(), arguments.device, max(arguments.repeats, 1), arguments.longest, arguments.files[0]
        )
    except KeyboardInterrupt:
        raise SystemExit(f"growth: stopped; {arguments.files[0]} holds what was measured") from None
    if keep(records, arguments.json):
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
