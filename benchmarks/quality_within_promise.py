"""Measure how often `fs.quality_within` keeps its bounds, on scenes that its candidates were not measured
with.

    python benchmarks/quality_within_promise.py [--device opencl:pocl] [--scenes 200] [--json FILE]

Errors: random scenes with held-out seeds, each with every bound of BOUNDS, against the float64 reference.
`promised` is the quality without a scene; `measured` that calibrated on the scene and camera; `elsewhere` the
same from another camera (rotated by 5 degrees, moved by a tenth of the distance); `crossing` the promised
quality in scenes where other splats intersect a coplanar group. Times: budgets of TIMES times the frame time
of TIMED in each scene; of FRAMES frames those within the budget are counted.
"""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from random_scenes import HELD_OUT, RandomScene, random_scene
from rich.progress import track

import fidsplat as fs
from fidsplat.accuracy.error import errors, reference_image
from fidsplat.accuracy.quality_within import choose
from fidsplat.experiments.bench.catalogue import BENCH_SCENES, TIMED
from fidsplat.util.errors import InputError
from fidsplat.util.timing import Timer, frame_timer, time_interleaved

BOUNDS = (1e-2, 1e-3, 1e-4)
SCENES = ("tag", "r100k_720p", "r1m_1080p")
TIMES = (0.5, 0.8, 1.0, 1.5, 3.0)
FRAMES = 30


@dataclass
class BoundStatistics:
    """Errors relative to a bound, and the share of scenes within it."""

    worst: list[float] = field(default_factory=list)
    """error of each scene, divided by the bound"""
    refused: int = 0
    """scenes without a promise"""

    def as_dict(self) -> dict:
        kept = sum(ratio <= 1 for ratio in self.worst)
        return {
            "promises": len(self.worst),
            "kept": kept,
            "refused": self.refused,
            "worst_over_bound": max(self.worst, default=math.nan),
            "median_over_bound": float(np.median(self.worst)) if self.worst else math.nan,
        }


def moved(scene: RandomScene) -> RandomScene:
    """The scene with a rotated and moved camera."""
    camera, (c, s) = scene.camera, (math.cos(math.radians(5)), math.sin(math.radians(5)))
    pose = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1.0]])
    pose[0, 3] = 0.1 * float(np.median(scene.cloud.means[:, 2]))
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return replace(
        scene, camera=fs.Camera.pinhole(camera.width, camera.height, *intrinsics, pose, near=camera.near)
    )


def capture_of(scene: RandomScene) -> fs.Capture:
    return fs.Capture(scene.camera, background=scene.background)


def errors_kept(renderer: fs.Renderer, count: int, measured: int) -> list[dict]:
    """A row for each kind of quality and bound, over `count` scenes, and over the first `measured` of
    them."""
    reference = fs.Renderer("reference")
    ways = ("promised", "crossing", "measured", "elsewhere")
    kept = {(way, bound): BoundStatistics() for way in ways for bound in BOUNDS}
    listed = {bound: fs.quality_within(error=bound, device=renderer) for bound in BOUNDS}

    def hold(way: str, bound: float, scene: RandomScene, quality: fs.Quality, want: np.ndarray) -> None:
        frame = renderer.render(scene.cloud, scene.camera, quality=quality, background=scene.background)
        kept[way, bound].worst.append(errors(frame["rgb"], want).maximum / bound)

    def truth_of(scene: RandomScene) -> np.ndarray:
        return reference_image(reference, scene.cloud, capture_of(scene))

    for k in track(range(count), "errors", console=PROGRESS):
        scene = random_scene(HELD_OUT + k)
        want = truth_of(scene)
        crossing = random_scene(HELD_OUT + k, crossing=True)
        mixed = truth_of(crossing)
        for bound, quality in listed.items():
            hold("promised", bound, scene, quality, want)
            hold("crossing", bound, crossing, quality, mixed)
        if k >= measured:
            continue
        elsewhere = moved(scene)
        there = truth_of(elsewhere)
        for bound in BOUNDS:
            place = {"scene": scene.cloud, "capture": capture_of(scene)}
            try:
                own = fs.quality_within(error=bound, device=renderer, **place)
            except InputError:
                kept["measured", bound].refused += 1
                continue
            hold("measured", bound, scene, own, want)
            hold("elsewhere", bound, elsewhere, own, there)
    return [{"way": way, "error": bound, **found.as_dict()} for (way, bound), found in kept.items()]


def times_kept(renderer: fs.Renderer, names: list[str]) -> list[dict]:
    """A row for each scene and budget."""
    rows = []
    for name in names:
        cloud, camera = BENCH_SCENES[name].make()
        resident = renderer.upload(cloud)
        usual = timed(renderer, resident, camera, TIMED, 10).median
        for times in track(TIMES, f"times, {name}", console=PROGRESS):
            ms = times * usual
            row = {"scene": name, "base_ms": usual, "budget_ms": ms}
            answers = []
            ask = partial(choose, ms=ms, scene=cloud, capture=camera, device=renderer)
            calibration = Timer(lambda answers=answers, ask=ask: answers.append(ask()), catch_errors=True)
            seconds = calibration.run() / 1e3
            if calibration.error:
                rows.append(row | {"refused": calibration.error})
                continue
            (found,) = answers
            taken = timed(renderer, resident, camera, found.quality, FRAMES)
            rows.append(
                row
                | {
                    "calibration_s": seconds,
                    "chosen": found.settings,
                    "error": found.error,
                    "frames": FRAMES,
                    "in_time": int((np.array(taken.ms) <= ms).sum()),
                    "median_ms": taken.median,
                    "p90_ms": float(np.quantile(taken.ms, 0.9)),
                }
            )
    return rows


def timed(renderer: fs.Renderer, resident, camera, quality, count: int) -> Timer:
    """Times of some frames, after a warm-up frame."""
    timer = frame_timer(renderer, resident, camera, quality=quality)
    time_interleaved([timer], count, warm_up=1)
    return timer


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--measured", type=int, default=60, help="scenes that are calibrated too")
    parser.add_argument("--timed", default=",".join(SCENES), help="bench scenes, or nothing")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # ignore earlier cached measurements
        renderer = fs.Renderer(arguments.device)
        found = {
            **facts(renderer),
            "scenes": arguments.scenes,
            "errors": errors_kept(renderer, arguments.scenes, arguments.measured),
            "times": times_kept(renderer, [name for name in arguments.timed.split(",") if name]),
        }
    if keep(found, arguments.json):
        return
    heads = ("way", "error", "kept", "refused", "worst / bound", "median / bound")
    show("Errors", heads, map(error_cells, found["errors"]))
    heads = ("scene", "budget ms", "error", "median ms", "in time", "calibrated in s")
    show("Times", heads, map(time_cells, found["times"]))


def error_cells(row: dict) -> tuple[str, ...]:
    ratios = (f"{row[f'{which}_over_bound']:.3g}" for which in ("worst", "median"))
    return (
        row["way"],
        f"{row['error']:g}",
        f"{row['kept']} of {row['promises']}",
        str(row["refused"]),
        *ratios,
    )


def time_cells(row: dict) -> tuple[str, ...]:
    budget = f"{row['budget_ms']:.1f}"
    if "refused" in row:
        return row["scene"], budget, row["refused"]
    numbers = f"{row['error']:.2g}", f"{row['median_ms']:.1f}", f"{row['in_time']} of {row['frames']}"
    return row["scene"], budget, *numbers, f"{row['calibration_s']:.1f}"


if __name__ == "__main__":
    main()
