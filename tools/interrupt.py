"""Test interrupts and full disks: no complete file may be lost, and the next run must be bit-identical.

    python tools/interrupt.py trials.jsonl [--commands demo,...] [--most 20] [--each 5] [--jobs 1] [--seed 0]

Each command runs twice undisturbed: content that agrees is its expected result (values of figures and logs,
lines of texts), and the rest (times, durations) must only parse. Each trial starts the command in an empty
folder and sends SIGINT, SIGTERM or SIGKILL at a random moment, or lets it write to a file system (tmpfs,
which requires root) that becomes full. All files with their final names are checked, and the same command
runs again with enough disk space. A trial is a line of the file; a stopped run resumes, and ends with a table
of all trials. The exit status is 1 if anything was lost.
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
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from fidsplat.cameras import Camera, Trajectory
from fidsplat.formats import save_ply, save_trajectory
from fidsplat.images.files import write_png
from fidsplat.scenes.random_clouds import random_splats

SIGNALS = ("SIGINT", "SIGTERM", "SIGKILL")
DISK = "full disk"
TIMED = ("repeats", "seconds.svg")
"""values and charts that depend on measured times, which may agree by chance"""
FIDSPLAT = (sys.executable, "-m", "fidsplat")
SCENE = """\
[camera]
width = 320
height = 240
fov_x_deg = 60.0
position = [0.3, 0.1, -0.8]
look_at = [0.0, 0.0, 0.0]

[[markers]]
spec = "apriltag:36h11:5"
size = 0.16
"""
FLIGHT = "0 0.3 0.1 -0.8 0 0 0 1\n1 0.2 0.1 -0.8 0 0 0 1\n"


class Command(NamedTuple):
    """A command that writes into its working folder."""

    words: str
    kills: int
    """number of trials with a signal"""
    disks: int
    """number of trials with a full disk"""
    own_cache: bool = False
    """whether it compiles its kernels, into a cache in its folder"""


RENDER = "render ../scene.toml -o image.png --outputs rgb,depth,normal,label"
COMMANDS = {
    "render": Command(RENDER, 96, 14),
    "marker": Command("marker qr-v22-L:text -o marker.ply", 61, 8),
    "counts": Command("experiment counts --quick --category small --category medium -o .", 57, 10),
    "compiling": Command(RENDER, 12, 4, own_cache=True),
    "demo": Command("demo --out .", 51, 2),
    "tradeoff": Command("tradeoff --quick --scenes apriltag --settings transmittance_stop -o .", 51, 2),
    "convert": Command("convert ../splats.ply splats.spz --overwrite", 60, 4),
    "fly": Command("fly ../scene.toml --trajectory ../flight.tum --rate 5 -o run.mcap", 60, 4),
    "bag": Command("fly ../scene.toml --trajectory ../flight.tum --rate 5 --log bag", 12, 0),
    "store": Command("store build ../splats.ply -o city.fss --chunk 256 --overwrite", 60, 4),
    "train": Command("train ../views -o out.ply --iterations 150 --random-points 200", 60, 2),
    "experiment": Command("experiment all --quick --category apriltag --mixture fitted -o .", 51, 1),
}
Facts = dict[Any, Any]


def _write_views(folder: Path) -> None:
    """A training data set of noise."""
    folder.mkdir()
    names, noise = [f"{number}.png" for number in range(4)], np.random.default_rng(0)
    for name in names:
        write_png(folder / name, noise.integers(0, 255, (48, 64, 3)).astype(np.uint8))
    camera = Camera.pinhole(64, 48, 60.0, 60.0, 32.0, 24.0)
    poses = np.stack([np.eye(4)] * 4)
    poses[:, 0, 3] = np.linspace(-0.3, 0.3, 4)
    save_trajectory(Trajectory(range(4), poses), folder / "transforms.json", camera, names)


def files_below(folder: Path) -> dict[str, Path]:
    """Files below a folder by name, without temporary ones, whose names begin with a dot."""
    names = (path.relative_to(folder) for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(name): folder / name for name in names if not any(part[0] == "." for part in name.parts)}


def facts(path: Path) -> Facts:
    """Content of a file: values of figures and logs by key, lines of texts, else its digest.

    Raises ValueError, OSError or EOFError for an incomplete file. A log may end within a line, which the
    resumed run drops.
    """
    content = path.read_bytes()
    match path.suffix:
        case ".json":
            return dict(_leaves(json.loads(content)))
        case ".jsonl":
            rows = [json.loads(line) for line in content.split(b"\n")[:-1]]
            return {
                (json.dumps(row["key"]), *place): value
                for row in rows
                if "key" in row  # excludes the header with facts of a run
                for place, value in _leaves(row["result"])
                if place[-1] not in TIMED
            }
        case ".png" | ".jpg":
            if cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) is None:
                raise ValueError("not an image")
        case ".npy":
            np.load(path)
        case ".npz":
            with np.load(path) as arrays:
                dict(arrays)
        case ".md" | ".csv" | ".svg" | ".html":
            if not content.endswith(b"\n"):
                raise ValueError("truncated")
            if path.name in TIMED:
                return {}
            return dict(enumerate(content.splitlines()))
    if not content:
        raise ValueError("empty")
    return {"digest": hashlib.sha256(content).hexdigest()}


def _leaves(value: Any, *place: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(item, *place, key)
    else:
        yield place, value


class Trial:
    """A command with its undisturbed result."""

    def __init__(self, command: Command, work: Path) -> None:
        self.command, self.work = command, work
        (work / "scene.toml").write_text(SCENE)
        (work / "flight.tum").write_text(FLIGHT)
        save_ply(random_splats(20_000, 0), work / "splats.ply")
        _write_views(work / "views")
        found = []
        for name in ("first", "second"):
            start = time.monotonic()
            status, said = self.run(self.folder(name))
            self.seconds = time.monotonic() - start
            if status != 0:
                raise SystemExit(f"{command.words} fails undisturbed: {said}")
            found.append({name: facts(path) for name, path in files_below(work / name).items()})
        first, second = found
        self.result = {
            name: {place: value for place, value in known.items() if second[name].get(place) == value}
            for name, known in first.items()
        }
        self.bytes = sum(path.stat().st_size for path in (work / "second").rglob("*") if path.is_file())

    def folder(self, name: str) -> Path:
        """Create an empty folder."""
        (self.work / name).mkdir()
        return self.work / name

    def start(self, folder: Path) -> subprocess.Popen[str]:
        """Start the command in a folder."""
        cache = {"POCL_CACHE_DIR": str(folder / ".cache")} if self.command.own_cache else {}
        (folder / ".cache").mkdir(exist_ok=True)
        words, pipe = (*FIDSPLAT, *self.command.words.split()), subprocess.PIPE
        env = os.environ | cache
        return subprocess.Popen(words, cwd=folder, env=env, stdout=pipe, stderr=pipe, text=True)

    def run(self, folder: Path) -> tuple[int, str]:
        """Run the command to its end; returns the exit status and stderr."""
        child = self.start(folder)
        return _end(child)

    def lost(self, folder: Path, status: int, said: str) -> Iterator[str]:
        """Damage of a disturbed run, and damage that the next run does not repair."""
        if not is_clear(status, said):
            yield f"ended with {status}: {said}"
        if status != -signal.SIGKILL:
            yield from (f"left {path.name}" for path in folder.rglob(".*.part"))
        yield from self._different(folder, growing=(".jsonl",), replaced=(".npz",))
        if folder.is_mount():
            subprocess.run(["mount", "-o", f"remount,size={4 * self.bytes + 2**24}", folder], check=True)
        status, said = self.run(folder)
        if status != 0:
            yield f"the next run ended with {status}: {said}"
        yield from self._different(folder)
        yield from (f"no {name}" for name in sorted(set(self.result) - set(files_below(folder))))

    def _different(
        self, folder: Path, growing: tuple[str, ...] = (), replaced: tuple[str, ...] = ()
    ) -> Iterator[str]:
        for name, path in files_below(folder).items():
            try:
                found = facts(path)
            except (ValueError, OSError, EOFError) as error:
                yield f"{name} is incomplete: {error}"
                continue
            if path.suffix in replaced:  # such as checkpoints
                continue
            for place, value in self.result.get(name, {}).items():
                if found.get(place) != value and (place in found or path.suffix not in growing):
                    yield f"{name} differs: {place}"
                    break


def _end(child: subprocess.Popen[str]) -> tuple[int, str]:
    said = child.communicate()[1]
    return child.returncode, said.strip()[-500:]


def is_clear(status: int, said: str) -> bool:
    """Whether a run succeeded, failed with a one-line message, or was killed by a signal."""
    if status in [-getattr(signal, name) for name in SIGNALS] and ", in main" not in said:
        return True  # during Python's start
    known = status == 0 or any(line.startswith("fidsplat: ") for line in said.splitlines())
    return known and "Traceback" not in said and "a fault of fidsplat" not in said


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """Mount a file system of `size` bytes at a folder."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", folder], check=True)


def disturb(trial: Trial, name: str, how: str, at: float) -> dict[str, Any]:
    """Disturb the command by a signal at a share of its time, or a disk for a share of its output; returns
    whether it stopped, and the damage."""
    folder = trial.folder(name)
    full = how == DISK
    with small_disk(folder, max(1, int(trial.bytes * at) // 4096) * 4096) if full else nullcontext():
        child = trial.start(folder)
        if not full:
            time.sleep(at * trial.seconds)
            child.send_signal(getattr(signal, how))
        begun = time.monotonic()
        status, said = _end(child)
        delay = round(time.monotonic() - begun, 2)
        return {"stopped": status != 0, "delay": delay, "lost": list(trial.lost(folder, status, said))}


def planned(name: str, seed: int) -> dict[str, tuple[str, float]]:
    """Kind and share of the disturbance of each trial of a command, by name."""
    command = COMMANDS[name]
    kinds = [*(f"{SIGNALS[k % 3]} {k // 3}" for k in range(command.kills))]
    kinds += [f"{DISK} {k}" for k in range(command.disks)]
    return {
        kind: (kind.rpartition(" ")[0], random.Random(f"{seed} {name} {kind}").random()) for kind in kinds
    }


def run_all(name: str, trials: list[tuple[str, str, float]], jobs: int) -> Iterator[dict[str, Any]]:
    """Run trials (name, how, at) of a command concurrently; yields a row for each as it ends."""
    with tempfile.TemporaryDirectory() as temporary:
        trial, pool = Trial(COMMANDS[name], Path(temporary)), ThreadPoolExecutor(jobs)
        try:
            running = {pool.submit(disturb, trial, *one): one for one in trials}
            for ended in as_completed(running):
                part, how, at = running[ended]
                yield {"command": name, "trial": part, "how": how, "at": round(at, 3), **ended.result()}
        finally:
            pool.shutdown(cancel_futures=True)  # after Ctrl-C the running trials end


def read(file: Path) -> list[dict[str, Any]]:
    """Trials in a file."""
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def table_of(done: list[dict[str, Any]]) -> Table:
    """Table by command: trials of each kind, stopped runs, longest time to end after a signal, trials with
    damage."""
    table = Table("command", *SIGNALS, DISK, "stopped", "slowest end [s]", "with damage")
    for name in [*dict.fromkeys(row["command"] for row in done), None]:
        rows = [row for row in done if name in (None, row["command"])]
        kinds = [sum(row["how"] == how for row in rows) for how in (*SIGNALS, DISK)]
        slowest = max((row["delay"] for row in rows if row["how"] != DISK), default=0.0)
        lost = sum(bool(row["lost"]) for row in rows)
        counts = [*kinds, sum(row["stopped"] for row in rows), slowest, lost]
        table.add_row(name or "all", *map(str, counts))
    return table


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="the trials, a line each")
    parser.add_argument("--commands", default=",".join(COMMANDS), help=f"of {', '.join(COMMANDS)}")
    parser.add_argument("--most", type=int, default=10**6, help="trials in this run (default: all)")
    parser.add_argument("--each", type=int, default=10**6, help="trials of each command (default: all)")
    parser.add_argument("--jobs", type=int, default=1, help="trials of a command that run at once")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    # background jobs of a shell ignore it, and their children would
    signal.signal(signal.SIGINT, signal.default_int_handler)
    names = given.commands.split(",")
    if unknown := set(names) - set(COMMANDS):
        parser.error(f"unknown commands {', '.join(sorted(unknown))}; known: {', '.join(COMMANDS)}")
    done = read(given.file)
    for name in names:
        there = {row["trial"] for row in done if row["command"] == name}
        left = [(part, *plan) for part, plan in planned(name, given.seed).items() if part not in there]
        left = [part for part in left if part[1] != DISK or os.geteuid() == 0]
        left = left[: min(given.most, given.each - len(there))]
        given.most -= len(left)
        if not left:
            continue
        for row in run_all(name, left, given.jobs):
            done.append(row)
            with given.file.open("a") as stream:
                stream.write(json.dumps(row) + "\n")
    for row in done:
        for words in row["lost"]:
            print(f"{row['command']}, {row['trial']} at {row['at']}: {words}")
    Console().print(table_of(done))
    return int(any(row["lost"] for row in done))


if __name__ == "__main__":
    sys.exit(main())
