"""Draws the 20 M scene at 3840 x 2160, repeated with other seeds until it holds so many splats.

    python benchmarks/large_scenes.py 20 50 --device opencl [--budget 4] [--json FILE]
    python benchmarks/large_scenes.py 100 --device opencl:nvidia

For each size in millions: seconds of the first frame and of one more, what the device holds, the process's
peak memory, and how the picture was fitted into the memory budget (GiB; the default is the device's own).
Each size is drawn in a process of its own, so that peaks are its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from datetime import date
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import fidsplat as fs
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.random_clouds import SCENES, random_cloud, standard_camera
from fidsplat.timing import Timer

SCENE = SCENES["r20m_4k"]


def cloud_of(millions: int) -> fs.SplatCloud:
    """The scene's splats of seeds 0, 1, ...; arrays are filled in place, so that they are held once."""
    count = millions * 1_000_000
    arrays = {
        name: np.empty((count, width) if width > 1 else count, np.float32)
        for name, width in (("means", 3), ("quats", 4), ("scales", 2), ("opacities", 1), ("colors", 3))
    }
    origin = np.zeros(3)
    for seed, first in enumerate(range(0, count, SCENE.count)):
        part = random_cloud(min(SCENE.count, count - first), SCENE.median_scale, seed)
        for name, array in arrays.items():
            array[first : first + len(part)] = getattr(part, name)
        arrays["means"][first : first + len(part)] += (part.origin - origin).astype(np.float32)
    for array in arrays.values():
        array.flags.writeable = False  # so that the cloud takes them over without a copy
    return fs.SplatCloud(**arrays, origin=origin)


def measure(millions: int, device: str, budget: float | None) -> dict:
    """Seconds, memory and the plan of one size."""
    cloud = cloud_of(millions)
    renderer = fs.Renderer(device, None if budget is None else round(budget * 2**30))
    resident = renderer.upload(cloud)
    camera = standard_camera(SCENE.width, SCENE.height)
    frame, mean = None, 0.0

    def draw() -> None:
        nonlocal frame, mean
        frame = renderer.render(resident, camera, quality=TIMED)
        mean = float(frame["rgb"].mean())

    seconds = [Timer(draw).run() / 1e3 for _ in range(2)]
    assert frame is not None
    return {
        "millions": millions,
        "device": f"{renderer.device.title}, {renderer.device.version}",
        "date": date.today().isoformat(),
        "budget_gib": budget,
        "first_s": seconds[0],
        "next_s": seconds[1],
        "stages_ms": dict(frame.timings),
        "device_bytes": renderer.backend.memory_bytes + resident.memory_bytes,
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "chunks": renderer.backend.pool.size("packed keys") > 0,
        "mean_rgb": mean,
        **frame.stats,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("millions", nargs="+", type=int)
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--budget", type=float, metavar="GIB")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside:
        print(json.dumps(measure(options.millions[0], options.device, options.budget)))
        return
    rows = []
    table = Table("splats", "first [s]", "next [s]", "device", "peak", "in chunks", "visible", "pairs")
    for millions in options.millions:
        command = [sys.executable, __file__, str(millions), "--device", options.device, "--inside"]
        if options.budget is not None:
            command += ["--budget", str(options.budget)]
        with Console(stderr=True).status(f"{millions} M splats on {options.device}"):
            made = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        row = json.loads(made.stdout)
        rows.append(row)
        if options.json:
            options.json.write_text(json.dumps(rows, indent=1) + "\n", "utf-8")
        table.add_row(
            f"{millions} M",
            f"{row['first_s']:.2f}",
            f"{row['next_s']:.2f}",
            *(f"{row[name] / 2**30:.2f} GiB" for name in ("device_bytes", "peak_bytes")),
            "yes" if row["chunks"] else "no",
            f"{row['visible']:,}",
            f"{row['pairs']:,}",
        )
    table.title = rows[-1]["device"]
    Console().print(table)


if __name__ == "__main__":
    main()
