"""A splat file fitted again from pictures of it, drawn here: what training gets back of a known scene.

    python benchmarks/refit.py FILE.ply [--device opencl] [--views 60] [--points 5000] [-o OUT]

Cameras look from all around, up to 50 degrees above and below, at the middle of what lies within 90 % of the
splats; one more for every ten stands between them and is held out. Training begins with random points in
that box.
Prints seconds, splats, and PSNR and SSIM of the views held out; -o keeps the splats and sheets of pictures.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from rich.progress import Progress

import fidsplat as fs
from fidsplat.files import writable_folder
from fidsplat.train import Dataset, Trainer, TrainingView
from fidsplat.vision.images import to_uint8, write_png

SIZE, FOV = (640, 640), math.radians(45.0)
BACKGROUND = (0.5, 0.5, 0.5)
HELD_OUT = 10
"""of so many views one more is compared with"""
HIGHEST = math.radians(50.0)
_TURN = math.pi * (3 - math.sqrt(5))


def box_of(cloud: fs.SplatCloud) -> tuple[np.ndarray, np.ndarray]:
    """Low and high corner (3,) of what holds the middle 90 % of the splats along each axis."""
    low, high = np.percentile(cloud.world_means(), (5, 95), axis=0)
    return low, high


def cameras(low: np.ndarray, high: np.ndarray, count: int, shift: float) -> list[fs.Camera]:
    """Cameras (y down) evenly over a band of directions; shift: of their places, 0.5 for those in between."""
    middle, away = (low + high) / 2, 0.75 * np.linalg.norm(high - low) / math.tan(FOV / 2)
    found = []
    for number in range(count):
        height = math.sin(HIGHEST) * (2 * (number + 0.5) / count - 1)
        angle, level = _TURN * (number + shift), math.sqrt(1 - height**2)
        towards = np.array([level * math.sin(angle), height, -level * math.cos(angle)])
        found.append(fs.Camera.look_at(*SIZE, FOV, middle + away * towards, middle))
    return found


def dataset_of(file: str, renderer: fs.Renderer, views: int, points: int) -> Dataset:
    """Pictures of the file's splats, and random points to begin with."""
    cloud = fs.load_ply(file)
    low, high = box_of(cloud)
    resident = renderer.upload(cloud)

    def drawn(stem: str, count: int, shift: float) -> tuple[TrainingView, ...]:
        found = []
        for number, camera in enumerate(cameras(low, high, count, shift)):
            frame = renderer.render(resident, camera, background=BACKGROUND)
            found.append(TrainingView(f"{stem}-{number:02d}.png", camera, to_uint8(frame["rgb"])))
        return tuple(found)

    random = np.random.default_rng(0)
    places, colors = random.uniform(low, high, (points, 3)), random.integers(0, 256, (points, 3))
    held_out = drawn("test", max(1, views // HELD_OUT), 0.5)
    return Dataset(file, drawn("view", views, 0.0), held_out, places, colors.astype(np.uint8), BACKGROUND)


def refit(dataset: Dataset, renderer: fs.Renderer, iterations: int, out: str | None) -> dict:
    """Seconds of the training, its splats, and means over the views held out."""
    trainer = Trainer(dataset, renderer, iterations=iterations)
    begun = time.perf_counter()
    with Progress(console=PROGRESS, transient=True) as bars:
        bar = bars.add_task("training", total=iterations)
        cloud = trainer.run(lambda step: bars.advance(bar))
    seconds = time.perf_counter() - begun
    scores = trainer.evaluate()
    if out is not None:
        folder = writable_folder(Path(out))
        fs.save_ply(cloud, folder / "refit.ply")
        for score, view in zip(scores, dataset.held_out, strict=True):
            write_png(folder / score.name, np.concatenate([view.picture, score.picture], axis=1))
    return {
        "splats": len(cloud),
        "seconds": seconds,
        "iterations": iterations,
        "psnr": float(np.mean([score.psnr for score in scores])),
        "ssim": float(np.mean([score.ssim for score in scores])),
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("file", help="splat file, y down")
    parser.add_argument("--views", type=int, default=60, help="to train on (default: 60)")
    parser.add_argument("--points", type=int, default=5000, help="to begin with (default: 5000)")
    parser.add_argument("--iterations", type=int, default=7000, help="of the training (default: 7000)")
    parser.add_argument("-o", "--out", metavar="DIR", help="keep the splats, and the truth beside them")
    given = parser.parse_args()
    renderer = fs.Renderer(given.device)
    dataset = dataset_of(given.file, renderer, given.views, given.points)
    found = refit(dataset, renderer, given.iterations, given.out) | {"views": given.views}
    if not keep(found | facts(renderer), given.json):
        row = [f"{value:.4g}" if isinstance(value, float) else f"{value}" for value in found.values()]
        show(f"{given.file}, {renderer.device.title}", list(found), [row])


if __name__ == "__main__":
    main()
