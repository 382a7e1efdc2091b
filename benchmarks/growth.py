"""Measures how frames grow with splats, pixels and overdraw, into a file of JSON lines.

    python benchmarks/growth.py growth.jsonl --device opencl
    python benchmarks/growth_plots.py growth.jsonl more.jsonl -o docs/images     draws what was measured

A series ends when a frame takes longer than --longest, or when the device cannot hold the scene. Each point
is written when it is done; a run that was stopped goes on where it was when it is given the same file. Needs
nothing beyond fidsplat itself.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console
from rich.progress import Progress, TextColumn
from rich.table import Table

import fidsplat as fs
from fidsplat.backends.base import Measurable
from fidsplat.experiments.bench.growth import Point, exponents, measure, points


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
    with Progress(*columns, console=Console(stderr=True)) as progress:
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="JSON lines; what it holds already is not measured again")
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=10, help="frames of each point (default: 10)")
    parser.add_argument("--longest", type=float, default=2.0, metavar="S", help="seconds (default: 2)")
    options = parser.parse_args()
    try:
        records = run(points(), options.device, max(options.repeats, 1), options.longest, options.file)
    except KeyboardInterrupt:
        raise SystemExit(f"growth: stopped; {options.file} holds what was measured") from None
    stages = list(dict.fromkeys(stage for record in records for stage in record.get("stages_ms", ())))
    table = Table("device", "over", "frame", *stages, title="Exponents over the upper half of each series")
    for title, series, found in exponents(records):
        cells = (found.get(name) for name in ("frame", *stages))
        table.add_row(title, series, *("-" if cell is None else f"{cell:.2f}" for cell in cells))
    Console().print(table)


if __name__ == "__main__":
    main()
