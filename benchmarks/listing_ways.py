"""Times both ways of making the tiles' lists on a device, frame by frame in turn.

    python benchmarks/listing_ways.py r100k_720p r1m_1080p --device opencl [--repeats 10] [--json FILE]

`ordered` sorts all visible splats by depth and lists them per tile in that order (counting sorts, no
atomics); `tiled` writes the pairs to their tiles in any order and sorts each tile's list in local memory.
Both give the same lists. devlog/growth.md says which one a device gets, and why.
"""

from __future__ import annotations

from dataclasses import replace

from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.backends.view import View
from fidsplat.effects import select
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.scenes.random_clouds import SCENES, load_scene
from fidsplat.util.timing import Timer, take_turns

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
            **facts(renderer),
            "repeats": repeats,
            "stages_ms": timer.part_medians,
        }
        for way, timer in timers.items()
    ]


def main() -> None:
    parser = options(__doc__, repeats=10)
    parser.add_argument("scenes", nargs="*", default=["r100k_720p"], choices=[*SCENES, []], metavar="SCENE")
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    rows = [row for name in asked.scenes for row in measure(renderer, name, max(asked.repeats, 1))]
    if keep(rows, asked.json):
        return

    def cells(row: dict) -> tuple[str, ...]:
        project, sort, bins = (row["stages_ms"][stage] for stage in ("project", "sort", "bin"))
        figures = (project, sort, bins, sort + bins)
        return row["scene"], row["way"], *(f"{figure:.2f}" for figure in figures)

    heads = ("scene", "way", "project", "sort", "bin", "both")
    show(f"ms on {renderer.device.title}", heads, map(cells, rows))


if __name__ == "__main__":
    main()
