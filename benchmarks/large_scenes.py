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

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.scenes.random_clouds import SCENES, random_cloud, standard_camera
from fidsplat.util.timing import Timer

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
    """Seconds and memory of one size."""
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
        **facts(renderer),
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
    parser = options(__doc__)
    parser.add_argument("millions", nargs="+", type=int)
    parser.add_argument("--budget", type=float, metavar="GIB")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.inside:
        print(json.dumps(measure(asked.millions[0], asked.device, asked.budget)))
        return
    rows: list[dict] = []
    for millions in asked.millions:
        command = [sys.executable, __file__, str(millions), "--device", asked.device, "--inside"]
        if asked.budget is not None:
            command += ["--budget", str(asked.budget)]
        with PROGRESS.status(f"{millions} M splats on {asked.device}"):
            made = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        rows.append(json.loads(made.stdout))
        if asked.json != "-":
            keep(rows, asked.json)
    if asked.json == "-":
        keep(rows, "-")
        return
    show(
        rows[-1]["device"],
        ("splats", "first [s]", "next [s]", "device", "peak", "in chunks", "visible", "pairs"),
        (
            (
                f"{row['millions']} M",
                f"{row['first_s']:.2f}",
                f"{row['next_s']:.2f}",
                *(f"{row[name] / 2**30:.2f} GiB" for name in ("device_bytes", "peak_bytes")),
                "yes" if row["chunks"] else "no",
                f"{row['visible']:,}",
                f"{row['pairs']:,}",
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
