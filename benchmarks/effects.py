"""What effects cost: a standard random scene without and with each, in turns, splats resident.

    python benchmarks/effects.py [NAME ...] --scene r1m_1080p --repeats 5 [--device opencl] [--json]

Medians of the wall time of one frame (the queue is drained before and after); base and base + effect are
drawn in turns, so that what else the machine does falls on both. The base is drawn twice, under two names:
how far their ratio is from 1 is the noise.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from datetime import date

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.experiments.scenes import SCENES, load_scene


def with_lens(lens, narrower: float = 1.0) -> Callable[[fs.Camera], dict]:
    """The base camera with a lens."""
    return lambda base: {
        "camera": fs.Camera.pinhole(
            base.width, base.height, narrower * base.fx, narrower * base.fy, base.cx, base.cy, lens=lens
        )
    }


def turning(time: float) -> np.ndarray:
    """A camera that turns by 30 degrees a second."""
    angle = math.radians(30) * time
    return fs.Camera.look_at(2, 2, 1.0, (0, 0, 0), (math.sin(angle), 0, math.cos(angle))).world_to_camera


def moved(time: float) -> np.ndarray:
    """A group that moves to the right at 1 m a second."""
    matrix = np.eye(4)
    matrix[0, 3] = time
    return matrix


TURN, GROUP = fs.Motion(turning), fs.Motion(None, {1: moved})
EFFECTS: dict[str, Callable[[fs.Camera], dict]] = {
    "base again": lambda base: {},
    "distortion": with_lens(fs.BrownConrady(-0.28, 0.07, p1=1e-3)),
    # the same field of view across the middle row
    "fisheye": with_lens(fs.Fisheye(0.01), math.tan(math.radians(30)) / math.radians(30)),
    "panorama": lambda base: {"camera": fs.Camera.equirectangular(base.width, base.height)},
    "parallel rays": lambda base: {"camera": fs.Camera.orthographic(base.width, base.height, 9.2)},
    "moving group": lambda base: {"motion": GROUP, "shutter": fs.Shutter(time=0.1)},
    "blur, 8 poses": lambda base: {"motion": TURN, "shutter": fs.Shutter(exposure=0.02)},
    "rolling, bands of 8 rows": lambda base: {"motion": TURN, "shutter": fs.Shutter(readout=0.02)},
    "rolling, bands of 64 rows": lambda base: {
        "motion": TURN,
        "shutter": fs.Shutter(readout=0.02, rows_per_band=64),
    },
}


def measure(names: list[str], scene: str, device: str, repeats: int) -> list[dict]:
    """Times of the base and of each effect, milliseconds."""
    renderer = fs.Renderer(device)
    cloud, camera = load_scene(scene)
    # every tenth splat moves where groups do
    resident = renderer.upload(cloud.with_labels((np.arange(len(cloud)) % 10 == 0).astype(np.int32)))

    def wall(options: dict) -> float:
        start = time.perf_counter()
        renderer.render(resident, options.get("camera", camera), **_rest(options)).timings  # noqa: B018 (waits)
        return (time.perf_counter() - start) * 1e3

    rows = []
    for name in track(names, description=scene, console=Console(stderr=True)):
        options = EFFECTS[name](camera)
        wall({}), wall(options)
        pairs = [(wall({}), wall(options)) for _ in range(repeats)]
        base, effect = (statistics.median(times) for times in zip(*pairs, strict=True))
        ratio = statistics.median(b / a for a, b in pairs)
        rows.append(
            {"effect": name, "base_ms": base, "effect_ms": effect, "price_percent": 100 * (ratio - 1)}
        )
    about = {
        "scene": scene,
        "device": f"{renderer.device.title} ({renderer.device.platform})",
        "driver": renderer.device.version,
        "date": date.today().isoformat(),
        "repeats": repeats,
    }
    return [about | row for row in rows]


def _rest(options: dict) -> dict:
    return {key: value for key, value in options.items() if key != "camera"}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", default=list(EFFECTS), choices=[*EFFECTS, []], metavar="NAME")
    parser.add_argument("--scene", default="r1m_1080p", choices=SCENES)
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = measure(list(options.names), options.scene, options.device, max(options.repeats, 1))
    if options.json:
        json.dump(rows, sys.stdout, indent=1)
        print()
        return
    table = Table(
        "effect", "base [ms]", "with it [ms]", "price", title=f"{options.scene}, {rows[0]['device']}"
    )
    for row in rows:
        table.add_row(
            row["effect"],
            f"{row['base_ms']:.0f}",
            f"{row['effect_ms']:.0f}",
            f"{row['price_percent']:+.0f} %",
        )
    Console().print(table)


if __name__ == "__main__":
    main()
