"""Measure a training step: random scenes trained on images of other random scenes.

    python benchmarks/training.py [SCENE ...] [--device opencl] [--degree 3] [--repeats 30] [--json FILE]

A step is a frame, its loss, its gradients and the optimiser for all splats, without densification. It is
timed by the clock, from the end of one step to the end of the next, which waits for the loss: median and
quartiles of the steps after ten warm-up steps. CPU time of the process is the mean over steps and all cores,
which is more reliable on a busy CPU. `host` is the CPU time of the launching thread.
"""

from __future__ import annotations

import time

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import track

import fidsplat as fs
from fidsplat.images.files import to_uint8
from fidsplat.scenes.random_clouds import SCENES, load_scene
from fidsplat.train import Dataset, Trainer, TrainingView
from fidsplat.util.timing import quartiles

WARM = 10


def trainer_of(name: str, renderer: fs.Renderer, degree: int, steps: int) -> Trainer:
    """Trainer without densification, which reaches the SH degree after a few steps."""
    cloud, camera = load_scene(name)
    other, _ = load_scene(name, seed=1)
    aside = camera.world_to_camera.copy()
    aside[0, 3] = 0.1
    views = [
        TrainingView(f"{i}", each, to_uint8(renderer.render(other, each)["rgb"]))
        for i, each in enumerate((camera, camera.with_pose(aside)))
    ]
    points = np.array([[0.0, 0.0, 8.0]])
    dataset = Dataset(name, tuple(views), (), points, np.zeros((1, 3), np.uint8))
    return Trainer(
        dataset,
        renderer,
        start=cloud,
        iterations=steps,
        sh_degree=degree,
        sh_every=1,
        densify_until=0,
        max_splats=len(cloud),
    )


def measure(name: str, renderer: fs.Renderer, degree: int, repeats: int) -> dict:
    """Milliseconds of a training step."""
    trainer = trainer_of(name, renderer, degree, WARM + repeats)
    for _ in range(WARM):
        trainer.step()
    times, last, cpu, host = [], time.perf_counter(), time.process_time(), time.thread_time()
    for _ in track(range(repeats), description=name, console=PROGRESS, transient=True):
        trainer.step()
        now = time.perf_counter()
        times.append((now - last) * 1e3)
        last = now
    cpu = (time.process_time() - cpu) * 1e3 / repeats
    host = (time.thread_time() - host) * 1e3 / repeats
    low, middle, high = quartiles(times)
    facts = {"scene": name, "degree": degree, "step_ms": middle, "quartiles_ms": [low, high]}
    return facts | {"cpu_ms": cpu, "host_ms": host}


def main() -> None:
    parser = options(__doc__, repeats=30)
    disks = [name for name, scene in SCENES.items() if not scene.thick]
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(disks)}")
    parser.add_argument("--degree", type=int, default=3, help="of the SH, 0 to 3 (default: 3)")
    given = parser.parse_args()
    renderer = fs.Renderer(given.device)
    found = [
        measure(name, renderer, given.degree, given.repeats) | facts(renderer)
        for name in given.scenes or ["r100k_720p"]
    ]
    if keep(found, given.json):
        return
    rows = [
        (
            one["scene"],
            f"{one['step_ms']:.1f}",
            " to ".join(f"{ms:.1f}" for ms in one["quartiles_ms"]),
            f"{one['cpu_ms']:.0f}",
            f"{one['host_ms']:.2f}",
        )
        for one in found
    ]
    show(
        f"{renderer.device.title}, SH degree {given.degree}",
        ("scene", "step [ms]", "quartiles", "CPU time [ms]", "host's [ms]"),
        rows,
    )


if __name__ == "__main__":
    main()
