"""Measure labelled images per hour: batches of views of one scene, with labels from the renderer.

python benchmarks/labelled_images.py                                     two cores, a minute
python benchmarks/labelled_images.py --device opencl:nvidia --batch 64 --batches 8 --json figures.json

The rows add up: rendering (rgb and label stay on the device), true corners and poses of all markers in
NumPy, transfer (rgb as 8 bits, label as 32 bits), and COCO annotations with run-length masks in threads,
while the device renders the next batch. Writing PNG files is measured alone.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.experiments.tag_causes import CAPTURED, GREENHOUSE, placed_in, scene_of
from fidsplat.images.files import write_png
from fidsplat.util.files import atomic_write
from fidsplat.util.provenance import run_facts
from fidsplat.vision.coco import CocoAnnotations
from fidsplat.vision.truth import Truth, truth_of
from fidsplat.worlds.greenhouse import Greenhouse

FOV = math.radians(70)


def views_of(name: str, count: int, width: int, height: int) -> tuple[fs.Scene, list[fs.Camera]]:
    """A scene with markers and random cameras that view them."""
    rng = np.random.default_rng(0)
    if name == GREENHOUSE:
        scene = Greenhouse(rows=2, plants=6).scene
        positions = rng.uniform((-1.2, 0.4, 0.4), (2.5, 1.1, 1.4), (count, 3))
        targets = positions + np.stack([np.ones(count), *rng.uniform(-0.6, 0.6, (2, count))], 1)
        up = (0.0, 0.0, 1.0)
    else:
        base, _, size = scene_of(name)
        placed = placed_in(name, "apriltag:36h11:5")
        scene = fs.Scene(base.clouds, markers=(placed,), background=base.background)
        targets = placed.pose[:3, 3] + size * rng.uniform(-1, 1, (count, 3))
        positions = targets + size * np.stack(
            [*rng.uniform(-3, 3, (2, count)), rng.uniform(-10, -3, count)], 1
        )
        up = (0.0, -1.0, 0.0)
    places = zip(positions, targets, strict=True)
    return scene, [fs.Camera.look_at(width, height, FOV, place, target, up) for place, target in places]


def seconds_of(work: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call, after a first call that compiles kernels."""
    taken = []
    for _ in range(repeats + 1):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return float(np.median(taken[1:]))


def measure(
    renderer: fs.Renderer, name: str, batch: int, repeats: int, threads: int, width: int, height: int
) -> dict:
    """Seconds per image by step, and images per hour."""
    scene, cameras = views_of(name, batch, width, height)
    resident = renderer.upload(scene)
    captures = [
        fs.Capture(camera, outputs=("rgb", "label"), background=scene.background) for camera in cameras
    ]
    pool = ThreadPoolExecutor(threads)

    def submitted() -> fs.FrameBatch:
        return renderer.render_batch(resident, captures)

    def render() -> fs.FrameBatch:
        return submitted().wait()

    poses = np.stack([placed.pose for placed in scene.markers])
    points = np.concatenate([placed.corners for placed in scene.markers])

    def labelled() -> list[tuple[np.ndarray, np.ndarray]]:
        return [(camera.world_to_camera @ poses, camera.project(points)) for camera in cameras]

    def transferred(frames: fs.FrameBatch) -> list[tuple[np.ndarray, np.ndarray]]:
        label = frames["label"]
        return [(frames.frame(k).to_uint8(), label[k]) for k in range(batch)]

    def annotated(images: list[tuple[np.ndarray, np.ndarray]]) -> list[Truth]:
        truths = list(
            pool.map(
                lambda pair: truth_of({"rgb": pair[1][0], "label": pair[1][1]}, scene, pair[0]),
                zip(cameras, images, strict=True),
            )
        )
        coco = CocoAnnotations()
        for k, truth in enumerate(truths):
            coco.add(f"{k:06d}.png", truth)
        return truths

    pending = [submitted()]

    def overlapped() -> list[Truth]:
        images = transferred(pending.pop().wait())
        pending.append(submitted())
        return annotated(images)

    steps = {
        "rendering": render,
        "and corners": lambda: (render(), labelled()),
        "and transfer": lambda: (transferred(render()), labelled()),
        "and COCO": overlapped,
    }
    found = {step: seconds_of(work, repeats) / batch for step, work in steps.items()}
    images = transferred(pending.pop().wait())
    visible = [marker.visible > 0 for truth in annotated(images) for marker in truth.markers]
    with tempfile.TemporaryDirectory() as folder:
        png = seconds_of(lambda: write_png(Path(folder) / "one.png", images[0][0]), 5)
    pool.shutdown()
    return {
        "scene": name,
        "splats": len(resident),
        "markers": len(scene.markers),
        "visible_markers": sum(visible) / batch,
        "milliseconds": {step: 1e3 * seconds for step, seconds in found.items()},
        "images_an_hour": {step: 3600 / seconds for step, seconds in found.items()},
        "png_milliseconds_on_one_core": 1e3 * png,
    }


def main() -> int:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default=None)
    parser.add_argument("--scene", action="append", choices=(GREENHOUSE, *CAPTURED), default=None)
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), help="pixels")
    parser.add_argument("--batch", type=int, default=4, help="views of a submission")
    parser.add_argument("--batches", type=int, default=3)
    threads = min(4, os.cpu_count() or 1)
    parser.add_argument("--threads", type=int, default=threads, help="that compute truth and masks")
    parser.add_argument("--json", default=None, help="file for the figures")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    figures = []
    for name in arguments.scene or [GREENHOUSE]:
        figures.append(
            measure(renderer, name, arguments.batch, arguments.batches, arguments.threads, *arguments.size)
        )
        print(
            "{scene}, {splats} splats, {markers} markers, {visible_markers:.1f} visible".format(**figures[-1])
        )
        for step, rate in figures[-1]["images_an_hour"].items():
            print(f"  {step:14} {figures[-1]['milliseconds'][step]:8.2f} ms {rate:12,.0f} an hour")
        print(f"  PNG of rgb     {figures[-1]['png_milliseconds_on_one_core']:8.2f} ms on one core")
    if arguments.json:
        facts = {"run": run_facts(renderer.device.title, 0), "size": arguments.size, "scenes": figures}
        with atomic_write(arguments.json) as stream:
            stream.write(json.dumps(facts, indent=1).encode())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
