"""Whether two GPUs slow each other: views of a cloud by each alone, by both from threads of one process, and
by both from a process each.

    python benchmarks/gpus_beside.py --devices opencl:nvidia opencl:nvidia-2 [--json FILE]

The cloud is a city (`fidsplat.store.city`) at --places places. Milliseconds are medians of --rounds views
with their rgb on the host, and seconds their sum, after two that are not counted.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
import time
from collections.abc import Sequence
from multiprocessing.queues import Queue
from pathlib import Path
from typing import Any

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from store_views import further, placed, views

import fidsplat as fs
from fidsplat.store.city import City


class Drawing:
    """A device with the cloud, and the views that it draws."""

    def __init__(self, device: str, path: Path, size: tuple[int, int], rounds: int) -> None:
        store = fs.Store(path)
        self._cameras = [views(store, size)["all"]]
        while len(self._cameras) < rounds + 2:
            self._cameras.append(further(self._cameras[-1]))
        self.renderer = fs.Renderer(device)
        self._there = self.renderer.upload(store.cloud())
        self.draw(3)

    def draw(self, count: int | None = None) -> list[float]:
        """Milliseconds of each view."""
        spent, begun = [], time.perf_counter()
        for frame in self.renderer.render_views(self._there, self._cameras[:count]):
            _ = frame["rgb"]
            spent.append(1e3 * (time.perf_counter() - begun))
            begun = time.perf_counter()
        return spent


def by_threads(drawings: Sequence[Drawing]) -> list[list[float]]:
    made: list[list[float]] = [[] for _ in drawings]

    def run(number: int) -> None:
        made[number] = drawings[number].draw()

    threads = [threading.Thread(target=run, args=(number,)) for number in range(len(drawings))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return made


def serve(given: tuple[Any, ...], asked: Queue, answers: Queue) -> None:
    """A process's part: draws whenever it is asked, until it is told to end."""
    drawing = Drawing(*given)
    answers.put(None)
    while asked.get():
        answers.put(drawing.draw())


class ByProcesses:
    """A process for each device."""

    def __init__(self, devices: Sequence[str], *given: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._lines = [(context.Queue(), context.Queue()) for _ in devices]
        pairs = zip(devices, self._lines, strict=True)
        self._workers = [context.Process(target=serve, args=((one, *given), *line)) for one, line in pairs]
        for worker in self._workers:
            worker.start()
        for _, answers in self._lines:
            answers.get(timeout=300)

    def draw(self, numbers: Sequence[int]) -> list[list[float]]:
        for number in numbers:
            self._lines[number][0].put(True)
        return [self._lines[number][1].get(timeout=300) for number in numbers]

    def end(self) -> None:
        for asked, _ in self._lines:
            asked.put(False)
        for worker in self._workers:
            worker.join()


def row_of(what: str, made: list[list[float]]) -> dict:
    row = {"what": what, "ms": [float(np.median(spent[2:])) for spent in made]}
    row["s"] = [sum(spent[2:]) / 1e3 for spent in made]
    PROGRESS.print(str(row))
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--devices", nargs="+", default=["opencl:nvidia", "opencl:nvidia-2"])
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--places", type=int, default=4, help="of the city, so many times")
    parser.add_argument("--rounds", type=int, default=16)
    parser.add_argument("--size", default="1920x1080")
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    everyone, rows = range(len(asked.devices)), []
    with tempfile.TemporaryDirectory() as folder:
        city = City(int(asked.splats))
        store = fs.Store(fs.build_store([city.source], Path(folder) / "city.fss", levels=False))
        given = placed(store, city, asked.places, Path(folder)).path, (width, height), asked.rounds
        drawings = [Drawing(device, *given) for device in asked.devices]
        about = {**facts(drawings[0].renderer), "devices": asked.devices, "size": asked.size}
        for number in everyone:
            rows.append(row_of(f"device {number} alone", [drawings[number].draw()]))
        rows.append(row_of("all, by threads", by_threads(drawings)))
        del drawings
        processes = ByProcesses(asked.devices, *given)
        for number in everyone:
            rows.append(row_of(f"process {number} alone", processes.draw([number])))
        rows.append(row_of("all, by processes", processes.draw(everyone)))
        processes.end()
    keep({**about, "splats": asked.places * int(asked.splats), "rows": rows}, asked.json)
    show(
        f"{about['device']}, {asked.places * int(asked.splats):,} splats, {asked.size}",
        ("who draws", "ms a view of each", "seconds of each"),
        (
            (row["what"], *(", ".join(f"{one:.{digits}f}" for one in row[unit]) for unit, digits in _SHOWN))
            for row in rows
        ),
    )


_SHOWN = (("ms", 1), ("s", 3))

if __name__ == "__main__":
    main()
