"""A commit against this tree: frames of both in turns, each in a process of its own.

    python benchmarks/before_after.py COMMIT [--scene r1m_1080p] [--device opencl] [--repeats 15] [--json]

Both processes draw the scene of this tree with its constants (alpha cut-off 1/255, stop 1e-4, precise
arithmetic), splats resident, the picture left on the device. One frame each, in turns, and which goes first
changes from pair to pair; the figure is the median of the ratios of this tree's time to the commit's, with
quartiles. So it is measured that the kernels of a scene without effects cost what they did before there were
effects.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path

from rich.console import Console
from rich.progress import track

ROOT = Path(__file__).resolve().parent.parent
WARM_UP = 3
CHILD = """
import hashlib, sys, time
import fidsplat as fs
sys.path.insert(0, sys.argv[3])
from fidsplat.random_clouds import load_scene
cloud, camera = load_scene(sys.argv[1])
renderer = fs.Renderer(sys.argv[2])
resident = renderer.upload(cloud)
knobs = {"arithmetic": "precise"} if "arithmetic" in fs.Quality.__dataclass_fields__ else {}
quality = fs.Quality(alpha_cutoff=1 / 255, transmittance_stop=1e-4, **knobs)
print(renderer.device.title, "|", renderer.device.version, flush=True)
for line in sys.stdin:
    start = time.perf_counter()
    frame = renderer.render(resident, camera, quality=quality)
    frame.timings
    spent = time.perf_counter() - start
    print(spent * 1e3, hashlib.sha256(frame["rgb"].tobytes()).hexdigest()[:16], flush=True)
"""


class Tree:
    """A process that draws with one tree's code."""

    def __init__(self, tree: Path, scene: str, device: str) -> None:
        self.child = subprocess.Popen(
            [sys.executable, "-c", CHILD, scene, device, str(tree)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=tree,
            env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tree), os.environ.get("PYTHONPATH", "")])},
        )
        self.device = self._line()
        self.picture = ""

    def frame(self) -> float:
        """Milliseconds of one more frame."""
        assert self.child.stdin is not None
        self.child.stdin.write("\n")
        self.child.stdin.flush()
        spent, self.picture = self._line().split()
        return float(spent)

    def _line(self) -> str:
        assert self.child.stdout is not None
        line = self.child.stdout.readline().strip()
        if not line:
            raise SystemExit("a process that draws has failed; its message stands above")
        return line

    def close(self) -> None:
        assert self.child.stdin is not None
        self.child.stdin.close()
        self.child.wait()


def checked_out(commit: str, folder: Path) -> Path:
    """A commit's files."""
    archive = subprocess.run(["git", "archive", commit], cwd=ROOT, check=True, capture_output=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    return folder


def measure(commit: str, scene: str, device: str, repeats: int) -> dict:
    """Both trees' times and the ratio of this tree's to the commit's."""
    with tempfile.TemporaryDirectory() as folder:
        old = Path(commit).resolve() if Path(commit).is_dir() else checked_out(commit, Path(folder))
        trees = [Tree(old, scene, device), Tree(ROOT, scene, device)]
        for _ in range(WARM_UP):
            [tree.frame() for tree in trees]
        times: list[list[float]] = [[], []]
        for turn in track(range(repeats), scene, console=Console(stderr=True)):
            for k in (0, 1) if turn % 2 else (1, 0):
                times[k].append(trees[k].frame())
        for tree in trees:
            tree.close()
    ratios = [mine / before for before, mine in zip(*times, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return {
        "scene": scene,
        "device": trees[1].device,
        "date": date.today().isoformat(),
        "commit": commit,
        "pairs": repeats,
        "before_ms": statistics.median(times[0]),
        "now_ms": statistics.median(times[1]),
        "ratio": middle,
        "quartiles": [low, high],
        "same_bits": trees[0].picture == trees[1].picture,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commit", help="any name that git knows, or a folder with its files")
    parser.add_argument("--scene", default="r1m_1080p")
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--repeats", type=int, default=15, help="pairs of frames, 2 or more")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    row = measure(options.commit, options.scene, options.device, max(options.repeats, 2))
    if options.json:
        print(json.dumps(row))
        return
    print("{scene} on {device}, {date}, {pairs} pairs".format(**row))
    print("{commit} {before_ms:.2f} ms, now {now_ms:.2f} ms".format(**row))
    print(
        "ratio {ratio:.3f}, quartiles {quartiles[0]:.3f} to {quartiles[1]:.3f}; ".format(**row)
        + ("the same bits" if row["same_bits"] else "pictures differ")
    )


if __name__ == "__main__":
    main()
