"""Training on views with disturbed poses: PSNR of held-out views with true poses, and with and without
refinement of the disturbed ones.

    python benchmarks/pose_refinement.py yard --iterations 2000 [--degrees 0.3] [--share 0.01] [--device D]
    python benchmarks/pose_refinement.py yard --time [--iterations 500] [--blocks 20] [--device D]

The data set is that of `fidsplat demo views -o yard`. Each training pose is rotated by normal numbers of so
many degrees, and moved by this share of the median depth of the points. Prints PSNR and SSIM of the held-out
views, the errors of the poses relative to the first one, and milliseconds per step.

`--time` compares steps with and without refinement, on the splats of a training of N iterations:
interleaved blocks of 50 steps, by the clock, without densification. A ratio is the median over blocks of the
time relative to the block without refinement next to it.
"""

import math
import time
from argparse import Namespace
from dataclasses import replace

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.splats.rotations import nearest_rotation
from fidsplat.train import Dataset, Trainer, load_dataset

BLOCK = 50
"""steps of a block"""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("dataset", help="folder")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--max-splats", type=int, default=20000)
    parser.add_argument("--degrees", type=float, default=0.3, help="standard deviation of rotations")
    parser.add_argument("--share", type=float, default=0.01, help="of positions, relative to the depth")
    parser.add_argument("--rate", type=float, default=5e-3, help="learning rate of poses")
    parser.add_argument("--refined-only", action="store_true", help="only the last of the three")
    parser.add_argument("--time", action="store_true", help="only compare the times of steps")
    parser.add_argument("--blocks", type=int, default=20, help="of 50 steps, with --time")
    words = parser.parse_args()
    renderer, given = fs.Renderer(words.device), load_dataset(words.dataset)
    if words.time:
        compare_times(given, renderer, words)
        return
    off = disturbed(given, math.radians(words.degrees), words.share)
    changes = {"pose_rate": words.rate, "pose_rate_end": words.rate / 100}
    rows = {}
    for name, dataset, refine in (
        ("true poses", given, False),
        ("disturbed poses", off, False),
        ("disturbed poses, refined", off, True),
    )[2 if words.refined_only else 0 :]:
        trainer = Trainer(dataset, renderer, iterations=words.iterations, max_splats=words.max_splats,
                          refine_poses=refine, **(changes if refine else {}))  # fmt: skip
        begun = time.process_time()
        trainer.run()
        took = 1e3 * (time.process_time() - begun) / words.iterations
        scores = trainer.evaluate()
        rows[name] = {
            "PSNR, dB": float(np.mean([score.psnr for score in scores])),
            "SSIM": float(np.mean([score.ssim for score in scores])),
            "position, mm": 1e3 * pose_errors(trainer, given)[0],
            "rotation, degrees": pose_errors(trainer, given)[1],
            "processor ms a step": took,
        }
        PROGRESS.print(name, rows[name])
    if not keep(facts(renderer) | {"rows": rows}, words.json):
        heads = ("", *next(iter(rows.values())))
        show(
            given.name,
            heads,
            [(name, *(f"{value:.4g}" for value in row.values())) for name, row in rows.items()],
        )


def compare_times(dataset: Dataset, renderer: fs.Renderer, words: Namespace) -> None:
    start = Trainer(dataset, renderer, iterations=words.iterations, max_splats=words.max_splats).run()
    refined = {
        "none": (),
        "poses": ("refine_poses",),
        "intrinsics": ("refine_intrinsics",),
        "exposures": ("fit_exposures",),
        "all": ("refine_poses", "refine_intrinsics", "fit_exposures"),
    }
    changes = {"densify_until": 0, "sh_every": 1, "iterations": 10**6, "max_splats": len(start)}
    trainers = {
        name: Trainer(dataset, renderer, start=start, **changes, **dict.fromkeys(switches, True))
        for name, switches in refined.items()
    }
    times: dict[str, list[float]] = {name: [] for name in trainers}
    for block in range(words.blocks + 1):
        for name, trainer in trainers.items():
            trainer.step()  # records the command lists, which the other trainers have replaced
            begun = time.perf_counter()
            for _ in range(BLOCK):
                trainer._advance(late=True)  # as `run` does
            trainer._read_losses()  # waits for the last step
            if block:
                times[name].append(1e3 * (time.perf_counter() - begun) / BLOCK)
    rows = {}
    for name, values in times.items():
        ratio = float(np.median(np.array(values) / times["none"]))
        rows[name] = {"step, ms": float(np.median(values)), "fastest, ms": min(values), "ratio": ratio}
    if not keep(facts(renderer) | {"splats": len(start), "rows": rows}, words.json):
        table = [(name, *(f"{value:.4g}" for value in row.values())) for name, row in rows.items()]
        show(f"{dataset.name}, {len(start):,} splats", ("refined", *next(iter(rows.values()))), table)


def disturbed(dataset: Dataset, angle: float, share: float) -> Dataset:
    random, views = np.random.default_rng(0), []
    for view in dataset.views:
        depth = np.median((dataset.points - view.camera.position) @ view.camera.world_to_camera[2, :3])
        motion = random.normal(size=6) * np.repeat([angle, share * depth], 3)
        # the rotation is about the camera
        views.append(replace(view, camera=offset_camera(view.camera, motion)))
    return replace(dataset, views=tuple(views))


def pose_errors(trainer: Trainer, given: Dataset) -> tuple[float, float]:
    """RMS errors of the training poses in metres and degrees, after the best rigid alignment."""
    found = np.array([view.camera.camera_to_world for view in trainer.views])
    true = np.array([view.camera.camera_to_world for view in given.views])
    # mean rotation between the two, then the mean shift
    rotation = nearest_rotation(np.einsum("nij,nkj->ik", true[:, :3, :3], found[:, :3, :3]))
    positions = found[:, :3, 3] @ rotation.T
    shifts = positions - true[:, :3, 3]
    shifts -= shifts.mean(axis=0)
    rotations = np.einsum("nji,njk->nik", true[:, :3, :3], rotation @ found[:, :3, :3])
    angles = np.arccos(np.clip((np.trace(rotations, axis1=1, axis2=2) - 1) / 2, -1, 1))
    return float(np.sqrt((shifts**2).sum(1).mean())), math.degrees(float(np.sqrt((angles**2).mean())))


if __name__ == "__main__":
    main()
