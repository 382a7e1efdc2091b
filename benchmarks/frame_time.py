"""Times whole frames of the standard random scenes, splats resident, picture left on the device.

    python benchmarks/frame_time.py r100k_720p r1m_1080p --device opencl --repeats 20 [--json]

Median and quartiles of the wall time of one frame (the queue is drained before and after), and medians of the
stages as the device itself measures them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from datetime import date

from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.experiments.scenes import SCENES, load_scene

STAGES = ("project", "sort", "bin", "blend", "resolve")


def measure(name: str, device: str, repeats: int) -> dict:
    """Times of one scene on one device, milliseconds."""
    renderer = fs.Renderer(device)
    cloud, camera = load_scene(name)
    resident = renderer.upload(cloud)
    start = time.perf_counter()
    frame = renderer.render(resident, camera)
    mean_rgb = float(frame["rgb"].mean())
    first = (time.perf_counter() - start) * 1e3
    walls, stages = [], {stage: [] for stage in STAGES}
    for _ in track(range(repeats), description=f"{name} on {device}", console=Console(stderr=True)):
        start = time.perf_counter()
        frame = renderer.render(resident, camera)
        timings = frame.timings  # waits for the device
        walls.append((time.perf_counter() - start) * 1e3)
        for stage in STAGES:
            stages[stage].append(timings[stage])
    quartiles = statistics.quantiles(walls, n=4)
    return {
        "scene": name,
        "device": f"{renderer.device.title} ({renderer.device.platform})",
        "driver": renderer.device.version,
        "date": date.today().isoformat(),
        "repeats": repeats,
        "frame_ms": quartiles[1],
        "quartiles_ms": [quartiles[0], quartiles[2]],
        "first_frame_ms": first,
        "stages_ms": {stage: statistics.median(values) for stage, values in stages.items()},
        "mean_rgb": mean_rgb,
        **frame.stats,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="*", default=["r100k_720p"], choices=[*SCENES, []], metavar="SCENE")
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [measure(scene, options.device, max(options.repeats, 2)) for scene in options.scenes]
    if options.json:
        json.dump(rows, sys.stdout, indent=1)
        print()
        return
    table = Table("scene", "frame [ms]", *STAGES, "visible", "pairs", "mean", title=rows[0]["device"])
    for row in rows:
        low, high = row["quartiles_ms"]
        table.add_row(
            row["scene"],
            f"{row['frame_ms']:.2f} ({low:.2f} to {high:.2f})",
            *(f"{row['stages_ms'][stage]:.2f}" for stage in STAGES),
            f"{row['visible']:,}",
            f"{row['pairs']:,}",
            f"{row['mean_rgb']:.4f}",
        )
    console = Console()
    console.width = max(console.width, 120)  # numbers are not to be broken
    console.print(table)


if __name__ == "__main__":
    main()
