"""Interrupts and full disks: whether anything whole is lost, and whether the next run has the same bits.

    python tools/interrupt.py kills [--moments 50] [--commands demo,render,...] [--seed 0] [--json FILE]
    python tools/interrupt.py disks [--sizes 8] [--commands ...] [--json FILE]

Each command runs twice undisturbed, into two folders: what agrees in both is its result, bit for bit; the
rest (times of day, durations) must only parse. `kills` then starts it again and again in an empty folder,
sends SIGINT, SIGTERM and SIGKILL in turn at random moments, looks at every file that has its final name, and
runs the command once more in the same folder. `disks` does the same on a file system (tmpfs, which only root
can mount) that is full after a part of what the command writes, and gives it room for the second run.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
FIDSPLAT = (sys.executable, "-c", "import sys; from fidsplat.cli import main; sys.exit(main())")
SCENE = """\
[camera]
width = 640
height = 480
fov_x_deg = 60.0
position = [0.3, 0.1, -0.8]
look_at = [0.0, 0.0, 0.0]

[[markers]]
spec = "apriltag:36h11:5"
size = 0.16

[render]
outputs = ["rgb", "depth", "normal", "label"]
"""
COMMANDS = {
    "demo": ("demo", "--out", "{out}"),
    "render": ("render", "{scene}", "-o", "{out}/picture.png", "--outputs", "rgb,depth,normal,label"),
    "marker": ("marker", "qr-v22-L:a long text", "-o", "{out}/marker.ply"),
    "counts": ("experiment", "counts", "--quick", "-o", "{out}"),
    "angles": ("experiment", "angles", "--quick", "-o", "{out}"),
    "experiment": ("experiment", "all", "--quick", "-o", "{out}"),
    "tradeoff": ("tradeoff", "--quick", "-o", "{out}"),
}
USUAL = ("demo", "render", "marker", "counts")


@dataclass
class Tally:
    """What happened to one command."""

    trials: int = 0
    interrupted: int = 0
    """trials in which the first run did not end by itself"""
    broken: int = 0
    """files under their final names that were not whole"""
    unclear: int = 0
    """runs that ended in something else than one line"""
    changed: int = 0
    """second runs that failed or whose result has other bits"""


def words(name: str, out: Path, scene: Path) -> list[str]:
    """A command's words."""
    return [*FIDSPLAT, *(word.format(out=out, scene=scene) for word in COMMANDS[name])]


def files_below(folder: Path) -> dict[str, Path]:
    """Files with their final names, by their names below the folder; temporary ones begin with a dot."""
    found = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(folder)): path for path in found}


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def is_whole(path: Path) -> bool:
    """Whether a file can be read to its end as what its name says."""
    content = path.read_bytes()
    try:
        match path.suffix:
            case ".json":
                json.loads(content)
            case ".jsonl":
                # a log grows by whole lines; a cut last line is repaired by the run that goes on
                for line in content.split(b"\n")[:-1]:
                    json.loads(line)
            case ".png" | ".jpg":
                return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) is not None
            case ".npy" | ".npz":
                np.load(path)
            case ".html" | ".svg":
                return content.rstrip().endswith((b"</html>", b"</svg>"))
    except (ValueError, OSError, EOFError):
        return False
    return len(content) > 0


class Trial:
    """A command with its undisturbed result."""

    def __init__(self, name: str, work: Path) -> None:
        self.name, self.scene = name, work / "scene.toml"
        self.scene.write_text(SCENE)
        folders = [work / f"{name}-whole-{k}" for k in range(2)]
        for folder in folders:
            start = time.monotonic()
            done = self.run(folder)
            self.seconds = time.monotonic() - start
            if done.returncode != 0:
                raise SystemExit(f"{name} fails undisturbed: {done.stderr.strip()}")
        first, second = ({n: digest(p) for n, p in files_below(folder).items()} for folder in folders)
        self.result = {n: value for n, value in first.items() if second.get(n) == value}
        self.names = set(first)
        self.bytes = sum(path.stat().st_size for path in files_below(folders[0]).values())

    def run(self, folder: Path, **options) -> subprocess.CompletedProcess[str]:
        """To its end."""
        folder.mkdir(exist_ok=True)
        return subprocess.run(words(self.name, folder, self.scene), capture_output=True, text=True, **options)

    def look(self, folder: Path, tally: Tally) -> None:
        """Counts what is broken among the files that have their final names."""
        for name, path in files_below(folder).items():
            good = digest(path) == self.result[name] if name in self.result else is_whole(path)
            # a log of results is whole line by line before it is whole
            tally.broken += not (good or (path.suffix == ".jsonl" and is_whole(path)))

    def go_on(self, folder: Path, tally: Tally) -> None:
        """Runs it once more and compares."""
        done = self.run(folder)
        now = {name: digest(path) for name, path in files_below(folder).items()}
        same = all(now.get(name) == value for name, value in self.result.items())
        tally.changed += done.returncode != 0 or not same or not self.names <= set(now)


def is_clear(done: subprocess.CompletedProcess[str] | subprocess.Popen[str], said: str) -> bool:
    """Whether a run that did not succeed ended in one line, or was killed outright."""
    if done.returncode in (0, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT):
        return "Traceback" not in said
    lines = [line for line in said.splitlines() if line.startswith("fidsplat: ")]
    return len(lines) >= 1 and "Traceback" not in said and "a fault of fidsplat" not in said


def kills(trial: Trial, work: Path, moments: int, chance: random.Random) -> Tally:
    """Interrupts at random moments."""
    tally = Tally()
    for k in track(range(moments), description=f"{trial.name}, kills", transient=True):
        folder = work / f"{trial.name}-kill-{k}"
        folder.mkdir()
        child = subprocess.Popen(
            words(trial.name, folder, trial.scene), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        time.sleep(chance.uniform(0.0, trial.seconds))
        tally.interrupted += child.poll() is None
        child.send_signal(SIGNALS[k % len(SIGNALS)])
        said = child.communicate()[1]
        tally.trials += 1
        tally.unclear += not is_clear(child, said)
        trial.look(folder, tally)
        trial.go_on(folder, tally)
    return tally


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """A file system of `size` bytes at a folder."""
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def disks(trial: Trial, work: Path, sizes: int) -> Tally:
    """Disks that are full after a part of what is written."""
    tally = Tally()
    for k in track(range(sizes), description=f"{trial.name}, full disks", transient=True):
        folder = work / f"{trial.name}-disk-{k}"
        with small_disk(folder, max(4096, trial.bytes * (k + 1) // (sizes + 1) // 4096 * 4096)):
            done = trial.run(folder)
            tally.trials += 1
            tally.interrupted += done.returncode != 0
            tally.unclear += not is_clear(done, done.stderr)
            trial.look(folder, tally)
            room = f"remount,size={4 * trial.bytes + 2**20}"
            subprocess.run(["mount", "-o", room, folder], check=True)
            trial.go_on(folder, tally)
    return tally


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("kills", "disks"))
    parser.add_argument("--moments", type=int, default=50, help="kills of each command (default: 50)")
    parser.add_argument("--sizes", type=int, default=8, help="sizes of the full disk (default: 8)")
    parser.add_argument("--commands", default=",".join(USUAL), help=f"of {', '.join(COMMANDS)}")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="the figures as a file")
    given = parser.parse_args()
    names = given.commands.split(",")
    if unknown := set(names) - set(COMMANDS):
        parser.error(f"unknown commands {', '.join(sorted(unknown))}; known: {', '.join(COMMANDS)}")
    if given.what == "disks" and os.geteuid() != 0:
        parser.error("disks mounts small file systems, which only root may do")
    tallies: dict[str, Tally] = {}
    chance = random.Random(given.seed)
    for name in names:
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            trial = Trial(name, work)
            tallies[name] = (
                kills(trial, work, given.moments, chance)
                if given.what == "kills"
                else disks(trial, work, given.sizes)
            )
    columns = tuple(Tally.__dataclass_fields__)
    table = Table("command", *columns)
    for name, tally in tallies.items():
        table.add_row(name, *(str(getattr(tally, column)) for column in columns))
    Console().print(table)
    if given.json:
        given.json.write_text(
            json.dumps({name: vars(tally) for name, tally in tallies.items()}, indent=1) + "\n"
        )
    return int(any(tally.broken + tally.unclear + tally.changed for tally in tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
