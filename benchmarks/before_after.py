"""Compare frame times of a commit and of this tree, interleaved, each in its own process.

    python benchmarks/before_after.py COMMIT [--scene r1m_1080p] [--device D] [--repeats 15] [--cpu-time]
                                      [--json FILE]
    python benchmarks/before_after.py COMMIT --pytest [WORDS] [--device D]

Both processes render a scene of this tree with equal constants (alpha cut-off 1/255, stop 1e-4, precise
arithmetic); splats and images stay on the device. The trees alternate frame by frame, and also alternate as
the first of a pair. The report has the median and quartiles of the ratio of this tree's time to the commit's,
and median stage times by the device clock. --cpu-time measures the CPU time of all threads, which other
processes disturb less.

--pytest runs `pytest benchmarks/` with both trees, one after the other, and compares them by
`pytest-benchmark compare`; WORDS are arguments of pytest, such as "-k tag".
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np
from measuring import PROGRESS, keep, options
from rich.progress import Progress

from fidsplat.experiments.bench.catalogue import BENCH_SCENES
from fidsplat.util.timing import Clock, Timer, quartiles, ratios, time_interleaved

ARRAYS = ("means", "quats", "scales", "opacities", "colors", "boxes", "coplanar_groups")
ROOT = Path(__file__).resolve().parent.parent
CHILD = """
import hashlib, json, sys, time
import numpy as np
import fidsplat as fs
scene = np.load(sys.argv[1])
given = {name: scene[name] for name in scene.files}
width, height, focal = given.pop("camera")
boxes, groups = given.pop("boxes", None), given.pop("coplanar_groups", None)
cloud = fs.SplatCloud(**given)
cloud = cloud if boxes is None else cloud.with_boxes(boxes)
grouped = getattr(cloud, "with_coplanar_groups", None) or cloud.with_planes
cloud = cloud if groups is None else grouped(groups)
camera = fs.Camera.pinhole(int(width), int(height), focal, focal, width / 2, height / 2)
renderer = fs.Renderer(sys.argv[2])
resident = renderer.upload(cloud)
settings = {"arithmetic": "precise"} if "arithmetic" in fs.Quality.__dataclass_fields__ else {}
quality = fs.Quality(alpha_cutoff=1 / 255, transmittance_stop=1e-4, **settings)
how = (fs.Capture(camera, quality=quality),) if "Capture" in fs.__all__ else (camera, ("rgb",), quality)
print(renderer.device.title, "|", renderer.device.version, flush=True)
clock = getattr(time, sys.argv[3])
for line in sys.stdin:
    start = clock()
    frame = renderer.render(resident, *how)
    getattr(frame, "wait", lambda: frame.timings)()
    spent = clock() - start
    digest = hashlib.sha256(frame["rgb"].tobytes()).hexdigest()[:16]
    print(spent * 1e3, digest, json.dumps(dict(frame.timings)), flush=True)
"""


def saved_scene(name: str, file: Path) -> Path:
    """Save a scene of `fidsplat bench` in a file that every commit can read."""
    cloud, camera = BENCH_SCENES[name].make()
    arrays = {field: getattr(cloud, field) for field in ARRAYS}
    if cloud.thickness is not None:
        arrays["scales"] = np.column_stack([cloud.scales, cloud.thickness])
    given = {field: array for field, array in arrays.items() if array is not None}
    np.savez(file, camera=(camera.width, camera.height, camera.fx), **given)
    return file


class Tree:
    """Process that renders with the code of a tree."""

    def __init__(self, tree: Path, scene: Path, device: str, clock: str) -> None:
        """clock: function of the module `time`."""
        self.child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(scene), device, clock],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=tree,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])},
        )
        self.device, self.clock = self._line(), Clock()
        self.digest = ""
        self.stages: list[dict[str, float]] = []
        """stage times of each frame in milliseconds"""

    def frame(self) -> None:
        """Render a frame and advance the clock by its time."""
        assert self.child.stdin is not None
        self.child.stdin.write("\n")
        self.child.stdin.flush()
        spent, self.digest, stages = self._line().split(maxsplit=2)
        self.stages.append(json.loads(stages))
        self.clock.seconds += float(spent) / 1e3

    def _line(self) -> str:
        assert self.child.stdout is not None
        line = self.child.stdout.readline().strip()
        if not line:
            raise SystemExit("a rendering process failed; its message is above")
        return line

    def medians(self) -> dict[str, float]:
        """Median stage times in milliseconds."""
        return {stage: float(np.median([one[stage] for one in self.stages])) for stage in self.stages[-1]}

    def close(self) -> None:
        assert self.child.stdin is not None
        self.child.stdin.close()
        self.child.wait()


def checked_out(commit: str, folder: Path) -> Path:
    """Extract the files of a commit."""
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder


def compare_suites(commit: str, words: Sequence[str]) -> int:
    """Run the suite of pytest-benchmark with a commit and with this tree; returns the status of the first
    failed command, or 0."""
    with tempfile.TemporaryDirectory() as folder:
        old = checked_out(commit, Path(folder))
        files = [f"{folder}/before.json", f"{folder}/now.json"]
        for tree, file in zip((old, ROOT), files, strict=True):
            path = os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])
            command = [sys.executable, "-m", "pytest", "benchmarks", "-q", f"--benchmark-json={file}", *words]
            status = subprocess.run(command, cwd=tree, env=os.environ | {"PYTHONPATH": path}).returncode
            if status:
                return status
        compare = [sys.executable, "-m", "pytest_benchmark", "compare", *files, "--group-by=fullname"]
        return subprocess.run([*compare, "--columns=min,median,iqr,rounds"]).returncode


def measure(commit: str, scene: str, device: str, repeats: int, clock: str) -> dict:
    """Times of both trees and the ratio of this tree to the commit."""
    with tempfile.TemporaryDirectory() as folder:
        old = Path(commit).resolve() if Path(commit).is_dir() else checked_out(commit, Path(folder))
        file = saved_scene(scene, Path(folder) / "scene.npz")
        trees = [Tree(old, file, device, clock), Tree(ROOT, file, device, clock)]
        before, now = (Timer(tree.frame, tree.clock) for tree in trees)
        with Progress(console=PROGRESS) as progress:
            task = progress.add_task(scene, total=2 * repeats)
            time_interleaved([before, now], repeats, warm_up=3, tick=lambda: progress.advance(task))
        for tree in trees:
            tree.close()
    low, middle, high = quartiles(ratios(now, before))
    return {
        "scene": scene,
        "device": trees[1].device,
        "date": date.today().isoformat(),
        "commit": commit,
        "pairs": repeats,
        "clock": clock,
        "before_ms": before.median,
        "now_ms": now.median,
        "ratio": middle,
        "quartiles": [low, high],
        "same_bits": trees[0].digest == trees[1].digest,
        "stages_ms": [tree.medians() for tree in trees],
    }


def main() -> None:
    parser = options(__doc__, repeats=15)
    parser.add_argument("commit", help="any name that git knows, or a folder with its files")
    parser.add_argument("--scene", default="r1m_1080p", choices=BENCH_SCENES)
    parser.add_argument(
        "--cpu-time", action="store_true", help="CPU time of all threads instead of wall time"
    )
    parser.add_argument("--pytest", metavar="WORDS", nargs="?", const="", help="compare the pytest suites")
    arguments = parser.parse_args()
    if arguments.pytest is not None:
        words = [f"--device={arguments.device}", *shlex.split(arguments.pytest)]
        raise SystemExit(compare_suites(arguments.commit, words))
    clock = "process_time" if arguments.cpu_time else "perf_counter"
    row = measure(arguments.commit, arguments.scene, arguments.device, max(arguments.repeats, 2), clock)
    if keep(row, arguments.json):
        return
    print("{scene} on {device}, {date}, {pairs} pairs".format(**row))
    print("{commit} {before_ms:.2f} ms, now {now_ms:.2f} ms".format(**row))
    for name, stages in zip((arguments.commit, "now"), row["stages_ms"], strict=True):
        print(f"{name}:", ", ".join(f"{stage} {spent:.3f}" for stage, spent in stages.items()))
    print(
        "ratio {ratio:.3f}, quartiles {quartiles[0]:.3f} to {quartiles[1]:.3f}; ".format(**row)
        + ("identical images" if row["same_bits"] else "images differ")
    )


if __name__ == "__main__":
    main()
