"""Measure cameras in a simulator: pose errors of tags, and environments per second.

python benchmarks/simulation.py                       the figures of docs/simulation.md
python benchmarks/simulation.py --device opencl:nvidia --environments 4096 --json figures.json
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.sim import Rig
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.files import atomic_write
from fidsplat.util.provenance import run_facts
from fidsplat.vision import read_back
from fidsplat.vision.readback import Reading

SIZE, DISTANCE = 0.16, 1.5
"""metres: edge of the tag, and its distance"""
TILT = math.radians(50)
"""maximum tilt of the tag in radians"""


def tag_poses(count: int) -> np.ndarray:
    """Random poses (count, 7) camera from tag within an image of 640 x 480 and 60 degrees, tilted by up to
    TILT."""
    rng = np.random.default_rng(0)
    across, down = rng.uniform(-0.45, 0.45, count), rng.uniform(-0.32, 0.32, count)
    rays = np.stack([across, down, np.ones(count)], 1)
    places = DISTANCE * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    axes, angles = rng.normal(size=(count, 2)), rng.uniform(0, TILT, count)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    quaternions = np.column_stack([np.cos(angles / 2), np.sin(angles / 2)[:, None] * axes, np.zeros(count)])
    return np.concatenate([places, quaternions], 1)


def readings(renderer: fs.Renderer, count: int) -> list[Reading]:
    """Readings of a tag in front of the camera, for random poses."""
    camera = fs.Camera.look_at(640, 480, math.radians(60), (0, 0, 0), (0, 0, 1))
    scene = fs.Scene(markers=(PlacedMarker(fs.marker("apriltag:36h11:5", size=SIZE)),), background=(0.5,) * 3)
    rig = Rig(scene, {1: "tag"}, {"camera": camera}, renderer=renderer)
    found = []
    for pose in tag_poses(count):
        images = rig.render({"tag": pose[None]})
        found += read_back(images.of("camera").frame(0), scene).readings
    return found


def environments_a_second(
    renderer: fs.Renderer, count: int, side: int, splats: int, repeats: int, quality: str
) -> dict[str, float]:
    """Environments per second, per second of CPU time (more reliable on a busy machine), both with rgb on the
    host, and per second with rgb on the device. Medians over steps in which every tag moves.
    """
    background = random_splats(splats, 3, depth=(2.0, 6.0), scale=(0.02, 0.2), across=1.5)
    tag = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.5), rigid_matrix((0, 0, 0)))
    camera = fs.Camera.look_at(side, side, math.radians(60), (0, 0, 0), (0, 0, 1))
    scene = fs.Scene((background.with_labels(0),), markers=(tag,), quality=quality)
    rig = Rig(scene, {1: "tag"}, {"c": camera}, renderer=renderer)
    rng = np.random.default_rng(1)
    seconds: list[tuple[float, float, float]] = []
    for _ in range(repeats + 1):
        pose = np.tile([0, 0, DISTANCE, 1.0, 0, 0, 0], (count, 1))
        pose[:, :2] += rng.uniform(-0.3, 0.3, (count, 2))
        start, begun = time.perf_counter(), time.process_time()
        images = rig.render({"tag": pose}).wait()
        rendered = time.perf_counter()
        _ = images["rgb"]
        seconds.append((time.perf_counter() - start, time.process_time() - begun, rendered - start))
    # the first step compiles
    rates = (count / np.median(seconds[1:], axis=0)).tolist()
    names = ("environments_a_second", "environments_a_core_second", "environments_a_second_on_the_device")
    return dict(zip(names, rates, strict=True))


def main() -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--tags", type=int, default=50, help="poses of the tag")
    parser.add_argument("--environments", type=int, default=64)
    parser.add_argument("--side", type=int, default=128, help="pixels")
    parser.add_argument("--splats", type=int, default=2000, help="of the background that environments share")
    parser.add_argument("--quality", default="standard", help="of environments: standard,order=centre ...")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", default=None, help="file for the figures")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    read = [one for one in readings(renderer, arguments.tags) if one.position_error is not None]
    errors = np.array([(one.position_error, one.angle_error, one.corner_error) for one in read], float)
    rates = environments_a_second(
        renderer,
        arguments.environments,
        arguments.side,
        arguments.splats,
        arguments.repeats,
        arguments.quality,
    )
    facts = {
        "run": run_facts(renderer.device.title, 0),
        "tags": arguments.tags,
        "read": len(read),
        "position_mm": (errors[:, 0] * 1e3).mean(),
        "position_worst_mm": (errors[:, 0] * 1e3).max(),
        "share_of_distance_percent": 100 * (errors[:, 0] / DISTANCE).mean(),
        "angle_deg": np.degrees(errors[:, 1]).mean(),
        "corners_px": errors[:, 2].mean(),
        "environments": arguments.environments,
        "side": arguments.side,
        "splats": arguments.splats,
        "quality": arguments.quality,
        **rates,
    }
    if arguments.json:
        with atomic_write(Path(arguments.json)) as stream:
            stream.write(json.dumps(facts, indent=2, default=float).encode())
    for name, value in facts.items():
        print(f"{name}: {value:.4g}" if isinstance(value, float) else f"{name}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
