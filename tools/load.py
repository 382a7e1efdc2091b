"""Load tests: threads, processes, damaged kernel caches, and a soak test.

    python tools/load.py threads [--device D]     one renderer used by 16 threads; 16 renderers in 16 threads
    python tools/load.py processes [--device D]   8 processes that share one empty kernel cache
    python tools/load.py caches [--device D]      every file of a kernel cache truncated, random or empty
    python tools/load.py soak [--minutes 120] [--frames 997] [--devices opencl,warp:cpu,reference]

Images must be bit-identical to those of one renderer in one thread. The soak test renders random scenes with
random effects in one process, renders them again much later, and monitors the memory.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats

THREADS, PROCESSES, VIEWS = 16, 8, 8
OUTPUTS = ("rgb", "depth", "normal", "label")
CHILD = """import sys
sys.path[:0] = sys.argv[2:]
import load
print(load.digest_of_views(load.fs.Renderer(sys.argv[1])))"""
SIZE = (160, 120)
FOUR_KINDS = ("perspective", "distortion", "fisheye", "orthographic")


def cloud_of(seed: int) -> fs.SplatCloud:
    """A few hundred splats in front of the camera."""
    return random_splats(400, seed, depth=(0.8, 4.0), scale=(0.02, 0.3), across=1.2)


def camera_of(view: int) -> fs.Camera:
    """One of the views of a scene."""
    angle = 2 * math.pi * view / VIEWS
    return fs.Camera.look_at(
        *SIZE, 1.0, position=(0.3 * math.cos(angle), 0.3 * math.sin(angle), 0), target=(0, 0, 2)
    )


def digest(frame: fs.Frame) -> str:
    """SHA-256 of all images of a frame."""
    state = hashlib.sha256()
    for name in frame:
        state.update(np.ascontiguousarray(frame[name]).tobytes())
    return state.hexdigest()


def digest_of_views(renderer: fs.Renderer, seed: int = 0) -> str:
    """Digest of all views of one scene."""
    resident = renderer.upload(cloud_of(seed))
    frames = [renderer.render(resident, camera_of(view), outputs=OUTPUTS) for view in range(VIEWS)]
    return hashlib.sha256("".join(map(digest, frames)).encode()).hexdigest()


def threads(device: str) -> dict[str, int]:
    """Number of wrong threads with one renderer for all, and with one for each."""
    seeds = range(THREADS)
    truth = [digest_of_views(fs.Renderer(device), seed) for seed in seeds]
    shared = fs.Renderer(device)
    with ThreadPoolExecutor(THREADS) as pool:
        together = list(pool.map(lambda seed: digest_of_views(shared, seed), seeds))
        apart = list(pool.map(lambda seed: digest_of_views(fs.Renderer(device), seed), seeds))
    return {
        "one renderer, wrong of 16 threads": sum(a != b for a, b in zip(truth, together, strict=True)),
        "16 renderers, wrong of 16 threads": sum(a != b for a, b in zip(truth, apart, strict=True)),
    }


def _start(device: str, cache: Path) -> subprocess.Popen[str]:
    """Start a process that renders with kernel caches in a folder."""
    folders = {
        name: str(cache / name.lower()) for name in ("POCL_CACHE_DIR", "XDG_CACHE_HOME", "WARP_CACHE_PATH")
    }
    for folder in folders.values():
        Path(folder).mkdir(exist_ok=True)
    here = str(Path(__file__).resolve().parent)
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, device, here, *sys.path],
        env=os.environ | folders,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wrong(child: subprocess.Popen[str], truth: str) -> bool:
    said, errors = child.communicate(timeout=900)
    if said.strip() != truth:
        print(errors.strip()[-400:] or f"different images: {said.strip()}", file=sys.stderr)
    return said.strip() != truth


def processes(device: str) -> dict[str, int]:
    """Number of wrong processes that share an empty cache."""
    truth = digest_of_views(fs.Renderer(device))
    with tempfile.TemporaryDirectory() as folder:
        children = [_start(device, Path(folder)) for _ in range(PROCESSES)]
        return {f"wrong of {PROCESSES} processes": sum(_wrong(child, truth) for child in children)}


def _noise(content: bytes) -> bytes:
    return random.Random(len(content)).randbytes(len(content))


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda content: content[: len(content) // 2],
    "noise": _noise,
    "empty": lambda content: b"",
}


def caches(device: str) -> dict[str, int]:
    """Number of wrong processes after every file of a cache was damaged, for each kind of damage."""
    truth = digest_of_views(fs.Renderer(device))
    figures = {}
    for name, damage in track(DAMAGES.items(), "damaged caches", transient=True):
        with tempfile.TemporaryDirectory() as folder:
            if _wrong(_start(device, Path(folder)), truth):
                figures[f"{name}: wrong before the damage"] = 1
            for path in Path(folder).rglob("*"):
                if path.is_file():
                    path.write_bytes(damage(path.read_bytes()))
            figures[f"{name}: wrong"] = int(_wrong(_start(device, Path(folder)), truth))
            figures[f"{name}: wrong once more"] = int(_wrong(_start(device, Path(folder)), truth))
    return figures


def _resident_bytes() -> int:
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def _random_frame(renderers: dict[str, fs.Renderer], seed: int) -> str:
    """Digest of a frame whose scene, camera and effects depend on a seed."""
    chance = random.Random(seed)
    width, height = chance.randrange(16, 400), chance.randrange(16, 300)
    camera = {
        "perspective": lambda: fs.Camera.pinhole(width, height, 100.0, 100.0, width / 2, height / 2),
        "distortion": lambda: fs.Camera.pinhole(
            width, height, 100.0, 100.0, width / 2, height / 2, lens=fs.BrownConrady(-0.1, 0.01)
        ),
        "fisheye": lambda: fs.Camera.fisheye(width, height, math.radians(170)),
        "orthographic": lambda: fs.Camera.orthographic(width, height, 4.0),
    }[chance.choice(FOUR_KINDS)]()
    cloud = random_splats(chance.randrange(1, 2000), seed, depth=(0.8, 4.0), scale=(0.02, 0.3), across=1.2)
    quality = fs.Quality(samples=chance.choice((1, 1, 2)), lowpass=chance.choice(("screen", "none")))
    fog = chance.choice((None, None, fs.Fog(0.2, (0.6, 0.65, 0.7))))
    name = chance.choice([*renderers, *(n for n in renderers if n != "reference")])
    if name == "reference":
        camera = fs.Camera.pinhole(24, 18, 20.0, 20.0, 12.0, 9.0)
    frame = renderers[name].render(cloud, camera, outputs=("rgb", "depth", "label"), quality=quality, fog=fog)
    return digest(frame)


def soak(minutes: float, devices: list[str], different: int = 997) -> dict[str, float]:
    """Render random frames for some minutes; returns differences and memory."""
    renderers = {device: fs.Renderer(device) for device in devices}
    first: dict[int, str] = {}
    memory: list[tuple[float, int]] = []
    wrong, seed, start = 0, 0, time.monotonic()
    with Console().status("soaking") as status:
        while (spent := time.monotonic() - start) < 60 * minutes:
            value = _random_frame(renderers, seed % different)
            wrong += first.setdefault(seed % different, value) != value
            seed += 1
            if seed % 50 == 0:
                memory.append((spent, _resident_bytes()))
                status.update(
                    f"{spent / 60:.1f} min, {seed} frames, {memory[-1][1] / 2**20:.0f} MiB, {wrong} wrong"
                )
    memory.append((spent, _resident_bytes()))
    early, late = levels(memory, 60 * minutes)
    return {
        "minutes": round(minutes, 1),
        "frames": seed,
        "frames that differ from their first rendering": wrong,
        "MiB after ten minutes": round(early / 2**20, 1),
        "MiB at the end": round(late / 2**20, 1),
        "growth in %": round(100 * (late / early - 1), 2),
    }


def levels(memory: list[tuple[float, int]], seconds: float) -> tuple[float, float]:
    """Median memory of (time, bytes) over ten minutes after the first ten, which fill caches and pools, and
    over the last ten. Medians ignore the buffers of single frames."""
    span = min(600.0, seconds / 6)
    early = [size for at, size in memory if span <= at <= 2 * span] or [memory[0][1]]
    late = [size for at, size in memory if at >= seconds - span] or [memory[-1][1]]
    return float(np.median(early)), float(np.median(late))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("threads", "processes", "caches", "soak"))
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--devices", default="opencl,warp:cpu,reference")
    parser.add_argument("--frames", type=int, default=997, help="different frames of a soak, each repeated")
    parser.add_argument("--json", type=Path, help="the figures as a file")
    given = parser.parse_args()
    if given.what == "soak":
        figures = soak(given.minutes, given.devices.split(","), given.frames)
        bad = figures["frames that differ from their first rendering"] + (figures["growth in %"] > 5)
    else:
        figures = {"threads": threads, "processes": processes, "caches": caches}[given.what](given.device)
        bad = sum(figures.values())
    table = Table(f"{given.what}, {given.device if given.what != 'soak' else given.devices}", "")
    for name, value in figures.items():
        table.add_row(name, str(value))
    Console().print(table)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1) + "\n")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
