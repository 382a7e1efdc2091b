"""Times both ways of making the tiles' lists on a device, frame by frame in turn.

    python benchmarks/listing_ways.py r100k_720p r1m_1080p --device opencl [--repeats 10] [--json FILE]

`ordered` sorts all visible splats by depth and lists them per tile in that order (counting sorts, no
atomics); `tiled` writes the pairs to their tiles in any order and sorts each tile's list in local memory.
Both give the same lists. docs/growth.md says which one a device gets, and why.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from datetime import date
from pathlib import Path

from rich.console import Console
from rich.table import Table

import fidsplat as fs
from fidsplat.backends.view import View
from fidsplat.effects import select
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.random_clouds import SCENES, load_scene
from fidsplat.timing import Timer, take_turns

WAYS = ("ordered", "tiled")


def measure(renderer: fs.Renderer, name: str, repeats: int) -> list[dict]:
    """Medians of the stages in milliseconds, one row for each way."""
    backend, quality = renderer.backend, TIMED
    cloud, camera = load_scene(name)
    resident = backend.upload(cloud)
    view = View.of(fs.Capture(camera, quality=quality), cloud.origin)
    features = select(resident, fs.Capture(camera, quality=quality))
    # the GPU's way scans with many work-items, the CPU's with one
    items = {"ordered": backend.shape.scan_items, "tiled": max(backend.shape.scan_items, 64)}
    ways = {
        way: backend.pipeline(features, replace(backend.shape, lists=way, scan_items=items[way]))
        for way in WAYS
    }
    timers = {way: Timer(lambda made=made: made.render(resident, view).timings) for way, made in ways.items()}
    take_turns(list(timers.values()), repeats, warm_up=1)
    return [
        {
            "scene": name,
            "way": way,
            "device": f"{renderer.device.title}, {renderer.device.version}",
            "date": date.today().isoformat(),
            "repeats": repeats,
            "stages_ms": timer.part_medians,
        }
        for way, timer in timers.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["r100k_720p"], choices=[*SCENES, []], metavar="SCENE")
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    renderer = fs.Renderer(options.device)
    rows = [row for name in options.scenes for row in measure(renderer, name, max(options.repeats, 1))]
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
    table = Table("scene", "way", "project", "sort", "bin", "both", title=f"ms on {renderer.device.title}")
    for row in rows:
        stages = row["stages_ms"]
        figures = (stages["project"], stages["sort"], stages["bin"], stages["sort"] + stages["bin"])
        table.add_row(row["scene"], row["way"], *(f"{figure:.2f}" for figure in figures))
    Console().print(table)


if __name__ == "__main__":
    main()
