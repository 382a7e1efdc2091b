"""Measure fidsplat/accuracy/candidates.json: the candidates of `fs.quality_within`, with errors and times.

    python benchmarks/candidates.py --device opencl:pocl       about 15 minutes on two busy cores
    python benchmarks/candidates.py --device opencl:nvidia     adds the candidates of GPUs

Each scene of `random_scenes.py` is rendered with every candidate and compared with the image at full
precision, in float64 (`fidsplat.accuracy.error.reference_renderer`). Costs are medians of interleaved frames
of the scenes of TIMED, of processor time on CPUs. In a second round, the Pareto front is rendered with all
sets of MODIFIERS (and OF_GPUS) and with FINEST; the new Pareto front is written. Settings that the device
lacks are skipped. Entries of other kinds of devices are unchanged.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from datetime import date

import numpy as np
from random_scenes import random_scene

import fidsplat as fs
from fidsplat.accuracy.candidates import FILE, Candidate
from fidsplat.accuracy.error import errors, reference_error, reference_image, reference_renderer
from fidsplat.scenes.random_clouds import random_cloud, standard_camera
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write
from fidsplat.util.timing import Timer, frame_timer, time_interleaved

CUTOFFS = (0.03, 0.015, 2 / 255, 1 / 255, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6, 1e-6, 1e-7)
STOPS = (0.05, 0.015, 4e-3, 1e-3, 1e-4, 1e-6)
MODIFIERS = (
    {"projection_precision": "float32"},
    {"arithmetic": "fast"},
    {"projection_precision": "float32", "arithmetic": "fast"},
)
OF_GPUS = tuple(
    {**setup, **more}
    for setup in ({}, {"projection_precision": "float32"})
    for more in ({"arithmetic": "approximate"}, {"blend_precision": "float16"})
)
"""further modifiers, which are not faster on CPUs"""
FINEST = (
    {"alpha_cutoff": 1e-8, "transmittance_stop": 0.0},
    {"alpha_cutoff": 1e-8, "transmittance_stop": 0.0, "blend_precision": "float64"},
)
TIMED = ((25_000, 0.05, 640, 360), (5_000, 0.2, 320, 240))
"""splats, median scale in metres, width, height: many small splats, and few large ones"""
SLACK = 1.02
"""times and errors this close are one: timings are noisy"""


class Measurement:
    """Settings of candidates, with their errors (scenes, candidates) and costs (candidates,)."""

    def __init__(self, candidates: list[dict], errors_: np.ndarray, costs: np.ndarray) -> None:
        self.candidates, self.errors, self.costs = candidates, errors_, costs

    def pareto_front(self) -> list[int]:
        """Indices of the Pareto front in cost, median error and largest error, up to SLACK."""
        what = np.log([self.costs, np.median(self.errors, 0), self.errors.max(0)]).T  # (candidates, 3)
        total, slack = what.sum(1), np.log(SLACK)
        return [
            k for k in range(len(what)) if not ((what <= what[k] + slack).all(1) & (total < total[k])).any()
        ]

    def of(self, chosen: list[int]) -> Measurement:
        """Measurement restricted to some candidates."""
        return Measurement([self.candidates[k] for k in chosen], self.errors[:, chosen], self.costs[chosen])

    def rows(self) -> list[dict]:
        """Rows of candidates.json, sorted by cost."""
        rows = []
        for settings, off, cost in zip(self.candidates, self.errors.T, self.costs.tolist(), strict=True):
            sizes = (round_up(size) for size in (np.quantile(off, 0.05), np.median(off), off.max()))
            rows.append(vars(Candidate(settings, *sizes, cost=round(cost, 3))))
        return sorted(rows, key=lambda row: row["cost"])


def round_up(value: float) -> float:
    """Round up to three significant digits."""
    return float(f"{value * 1.0005:.3g}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--device", default="opencl:pocl")
    parser.add_argument("--scenes", type=int, default=400)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--out", default=str(FILE))
    args = parser.parse_args()
    renderer = fs.Renderer(args.device)
    reference = reference_renderer(renderer, fs.Capture())

    say(f"truths of {args.scenes} scenes by {reference.device.name}")
    scenes = [random_scene(seed) for seed in range(args.scenes)]
    truths = []
    for k, scene in enumerate(scenes):
        truths.append(
            reference_image(reference, scene.cloud, fs.Capture(scene.camera, background=scene.background))
        )
        say(f"truths: {k + 1} of {args.scenes}", end="\r")

    def measure(candidates: list[dict]) -> Measurement:
        found = all_errors(renderer, scenes, truths, candidates)
        return Measurement(candidates, found, all_costs(renderer, candidates, args.repeats))

    grid = [{"alpha_cutoff": cut, "transmittance_stop": stop} for cut in CUTOFFS for stop in STOPS]
    plain = measure(grid)
    plain = plain.of(plain.pareto_front())
    say(f"{len(plain.candidates)} of {len(grid)} are on the front")
    modifiers = (*MODIFIERS, *(OF_GPUS if renderer.device.kind == "gpu" else ()))
    modifiers = [more for more in modifiers if supports(renderer, scenes[0], more)]
    finest = [settings for settings in FINEST if supports(renderer, scenes[0], settings)]
    combined = [settings | more for settings in plain.candidates for more in modifiers]
    both = measure(plain.candidates + combined + finest)
    final = both.of(both.pareto_front())
    say(f"{len(final.candidates)} of {len(both.candidates)} are on the Pareto front")

    out = json.loads(FILE.read_text("utf-8")) if FILE.exists() else {"made": {}, "classes": {}}
    info = renderer.device
    out["classes"][info.kind] = {"candidates": final.rows()}
    out["made"][info.kind] = {
        "device": info.title,
        "driver": info.version,
        "date": date.today().isoformat(),
        "scenes": args.scenes,
        "reference": reference.device.name,
        "fidsplat": fs.__version__,
    }
    with atomic_write(args.out) as stream:
        stream.write((json.dumps(out, indent=1) + "\n").encode())
    return 0


def say(text: str, end: str = "\n") -> None:
    print(text, file=sys.stderr, end=end, flush=True)


def quality(settings: dict) -> fs.Quality:
    return Candidate(settings, 0, 0, 0, 0).quality(fs.Quality())


def supports(renderer: fs.Renderer, scene, settings: dict) -> bool:
    try:
        renderer.render(scene.cloud, scene.camera, quality=quality(settings))
    except InputError as error:
        say(f"left out: {error}")
        return False
    return True


def all_errors(renderer: fs.Renderer, scenes, truths, candidates: list[dict]) -> np.ndarray:
    """Largest absolute error of rgb (scenes, candidates)."""
    qualities = [quality(settings) for settings in candidates]
    found = np.empty((len(scenes), len(candidates)))
    off = reference_error(reference_renderer(renderer, fs.Capture()), fs.Capture())
    for k, (scene, want) in enumerate(zip(scenes, truths, strict=True)):
        resident = renderer.upload(scene.cloud)
        for j, each in enumerate(qualities):
            frame = renderer.render(resident, scene.camera, quality=each, background=scene.background)
            found[k, j] = errors(frame["rgb"], want).maximum + off
        say(f"errors: {k + 1} of {len(scenes)} scenes, {len(candidates)} candidates", end="\r")
    say("")
    return found


def all_costs(renderer: fs.Renderer, candidates: list[dict], repeats: int) -> np.ndarray:
    """Frame time relative to the candidates' base (candidates,), mean over the timed scenes."""
    qualities = [quality({}), *(quality(settings) for settings in candidates)]
    # CPU time hardly depends on other processes
    clock = time.process_time if renderer.device.kind == "cpu" else time.perf_counter
    ratios = []
    for count, scale, width, height in TIMED:
        resident, camera = renderer.upload(random_cloud(count, scale)), standard_camera(width, height)
        frames = [frame_timer(renderer, resident, camera, quality=each) for each in qualities]
        timers = [Timer(frame.run, clock) for frame in frames]
        say(f"times: {repeats} rounds, {count:,} splats")
        time_interleaved(timers, repeats, warm_up=1)
        ratios.append(np.array([timer.median for timer in timers[1:]]) / timers[0].median)
    return np.mean(ratios, 0)


if __name__ == "__main__":
    sys.exit(main())
