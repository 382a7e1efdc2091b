"""Many views by workers that are killed: whether all are whole, and none was drawn twice.

A flight past a marker is drawn by Ray on a cluster of this machine, whose workers are killed meanwhile, one
after each share of the views, and again by this process alone. Files are compared byte by byte.

    pip install '.[ray]' && PYTHONPATH=. python benchmarks/remote.py --views 1000 --workers 3 --kills 3
"""

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import ray

import fidsplat as fs
from fidsplat.remote.flights import FlightWork, draw
from fidsplat.remote.ray_engine import ray_engine
from fidsplat.render.flight import Flight, FlightFolder
from fidsplat.scenes import PlacedMarker


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--size", type=int, nargs=2, default=(64, 48), metavar=("W", "H"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=3)
    words = parser.parse_args()
    flight = past_a_marker(words.views, *words.size)
    with tempfile.TemporaryDirectory() as folder:
        drawn, seconds, alive = by_workers(flight, Path(folder, "many"), words)
        twice = sum(count > 1 for count in drawn.values())
        print(
            f"{len(drawn)} of {words.views} views drawn, {twice} of them twice, {words.kills} workers killed"
        )
        print(f"{seconds:.1f} s, {words.views / seconds:.1f} views a second, {alive} workers started")
        alone = FlightFolder(Path(folder, "one"), flight, fs.Renderer(words.device).device.title)
        list(alone.draw(fs.Renderer(words.device)))
        others = [
            file for file in alone.folder.glob("rgb/*")
            if file.read_bytes() != Path(folder, "many", "rgb", file.name).read_bytes()
        ]  # fmt: skip
        print(f"{len(others)} files differ from those of one process")


def past_a_marker(views: int, width: int, height: int) -> Flight:
    """A flight of so many views."""
    scene = fs.Scene(
        markers=[PlacedMarker(fs.marker("aruco:4x4_50:7", size=0.4))],
        camera=fs.Camera.look_at(width, height, 1.0, (0, 0, -1), (0, 0, 0)),
    )
    path = fs.Trajectory([0.0, 1.0], [[-0.3, 0, -1, 1, 0, 0, 0], [0.3, 0, -1, 1, 0, 0, 0]])
    return Flight(scene, path, np.linspace(0, 1, views), scene.capture)


def by_workers(flight: Flight, folder: Path, words: argparse.Namespace) -> tuple[Counter, float, int]:
    """How often each view was drawn, seconds, and how many workers were started."""
    drawn: Counter = Counter()
    with ray_engine("local", FlightWork(flight, words.device), words.workers) as engine:
        kept = FlightFolder(folder, flight, engine.title)
        begun = time.perf_counter()
        for k in draw(kept, engine, engine.workers):
            drawn[k] += 1
            done = sum(drawn.values())
            share = len(flight) // (words.kills + 1)
            if share and done % share == 0 and done // share <= words.kills:
                ray.kill(engine._actors[done // share - 1])
        return drawn, time.perf_counter() - begun, len(engine._actors)


if __name__ == "__main__":
    main()
