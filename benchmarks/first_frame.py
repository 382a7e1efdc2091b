"""Measure the first frame of a new process with empty kernel caches, with caches filled by `fidsplat warm`,
and with caches filled by the same scene.

    python benchmarks/first_frame.py [tag] [demo] [--device opencl] [--repeats 5] [--json FILE]

The report has the seconds from the start of Python to the image in NumPy, and of each step: start of Python,
imports, construction of the scene with its markers, opening the device, upload and rendering including all
compilation. The caches of pyopencl, PoCL and NVIDIA's driver are redirected to temporary folders.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

from measuring import PROGRESS, keep, options, show
from rich.progress import track

SCENES = ("tag", "demo")
CACHES = ("empty", "warmed", "kept")
PARTS = ("python", "import", "scene", "device", "frame")

# prints the end time of each part in seconds since the epoch
CHILD = """
import time; marks = [time.time()]
import sys, fidsplat as fs, numpy; marks.append(time.time())
if sys.argv[1] == "demo":
    from fidsplat.worlds.yard import demo_scene
    scene, camera = demo_scene(), None
else:
    from fidsplat.experiments.bench.catalogue import BENCH_SCENES
    scene, camera = BENCH_SCENES[sys.argv[1]].make()
marks.append(time.time())
renderer = fs.Renderer(sys.argv[2]); marks.append(time.time())
frame = renderer.render(scene, camera)
for name in frame: frame[name]
marks.append(time.time())
print(*marks)
"""


def caches_in(folder: Path) -> dict[str, str]:
    """Environment variables that move all kernel caches into `folder`."""
    places = {
        "POCL_CACHE_DIR": str(folder / "pocl"),
        "XDG_CACHE_HOME": str(folder / "xdg"),
        "CUDA_CACHE_PATH": str(folder / "nv"),
    }
    for place in places.values():
        Path(place).mkdir(parents=True, exist_ok=True)
    return os.environ | places


def first_frame(scene: str, device: str, folder: Path) -> dict[str, float]:
    """Seconds of each step, and in `total`, of a new process that renders one frame."""
    begun = time.time()
    done = subprocess.run(
        [sys.executable, "-c", CHILD, scene, device], capture_output=True, text=True, env=caches_in(folder)
    )
    if done.returncode:
        raise SystemExit(f"first_frame: {done.stderr.strip().splitlines()[-1]}")
    marks = [begun, *map(float, done.stdout.split())]
    parts = {part: after - before for part, before, after in zip(PARTS, marks[:-1], marks[1:], strict=True)}
    return parts | {"total": marks[-1] - begun}


def warm(device: str, folder: Path) -> float:
    """Seconds that `fidsplat warm` takes with empty caches."""
    begun = time.time()
    command = [sys.executable, "-m", "fidsplat", "warm", "--device", device]
    subprocess.run(command, capture_output=True, check=True, env=caches_in(folder))
    return time.time() - begun


def measure(scenes: list[str], device: str, repeats: int) -> list[dict]:
    """A record for each scene and state of the caches: medians, and minimum and maximum of the total."""
    records = []
    with tempfile.TemporaryDirectory() as name:
        top = Path(name)
        with PROGRESS.status("fidsplat warm"):
            warmed_in = warm(device, top / "warmed")
        for scene in scenes:
            runs: dict[str, list[dict[str, float]]] = {cache: [] for cache in CACHES}
            for number in track(range(repeats), description=scene, console=PROGRESS):
                # kept: the caches of the first run with empty caches
                folders = {"empty": top / f"{scene} {number}", "kept": top / f"{scene} 0"}
                for cache in CACHES:
                    runs[cache].append(first_frame(scene, device, folders.get(cache, top / "warmed")))
            for cache, taken in runs.items():
                totals = [run["total"] for run in taken]
                records.append(
                    {
                        "scene": scene,
                        "device": device,
                        "date": date.today().isoformat(),
                        "caches": cache,
                        "repeats": repeats,
                        "seconds": {p: statistics.median(run[p] for run in taken) for p in taken[0]},
                        "range": [min(totals), max(totals)],
                        "warm_seconds": warmed_in,
                    }
                )
    return records


def main() -> None:
    parser = options(__doc__, repeats=5)
    parser.add_argument("scenes", nargs="*", default=list(SCENES), metavar="SCENE")
    arguments = parser.parse_args()
    records = measure(arguments.scenes, arguments.device, max(arguments.repeats, 1))
    if keep(records, arguments.json):
        return

    def cells(record: dict) -> tuple[str, ...]:
        seconds, (low, high) = record["seconds"], record["range"]
        parts = (f"{seconds[part]:.2f}" for part in PARTS)
        total = f"{seconds['total']:.2f}"
        return record["scene"], record["caches"], total, f"{low:.2f} to {high:.2f}", *parts

    warmed = f"fidsplat warm, with empty caches: {records[0]['warm_seconds']:.1f} s"
    heads = ("scene", "caches", "seconds", "range", *PARTS)
    show(f"First frame on {arguments.device}; {warmed}", heads, map(cells, records))


if __name__ == "__main__":
    main()
