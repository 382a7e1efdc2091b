"""Views along a street of a city on disk, where houses hide most of it.

    python benchmarks/store_street.py [--splats 4e6] [--places 50] [--qualities standard ...] [--json FILE]

The city is built as `store_views.py` builds it (under --folder it is kept). The camera drives down a street
by --step metres a view, and turns in the last third of the path. Of each view: splats that lie in it, that it
was drawn of, seconds, and processor time of this process. Qualities are as of `fidsplat render`.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options
from store_views import path_of, placed

import fidsplat as fs
from fidsplat.accuracy.detail_errors import measure_detail
from fidsplat.streaming.occlusion_culling import OcclusionCulling
from fidsplat.worlds.city import City


def cameras(store: fs.Store, size: tuple[int, int], count: int, step: float) -> list[fs.Camera]:
    """From 300 m within the city on, at the height of eyes."""
    low, high = store.bounds()
    made = []
    for number in range(count):
        at = np.array([(low[0] + high[0]) / 2, -1.7, low[2] + min(300.0, (high[2] - low[2]) / 8)])
        at[2] += step * number
        turn = 0.05 * max(number - count * 2 // 3, 0)
        towards = at + np.array([math.sin(turn), 0.0, math.cos(turn)])
        made.append(fs.Camera.look_at(*size, math.radians(60), at, towards))
    return made


def drive(renderer: fs.Renderer, store: fs.Store, quality: str, path: list[fs.Camera]) -> list[dict]:
    """A row for each view."""
    rows, resident, counts = [], renderer.upload(store), []
    drawn = OcclusionCulling.render

    def noted(self, whole, *given):
        counts.append(whole.count)
        return drawn(self, whole, *given)

    OcclusionCulling.render = noted
    try:
        for camera in path:
            begun, cpu = time.perf_counter(), time.process_time()
            frame = renderer.render(resident, camera, quality=quality)
            _ = frame["rgb"]
            row = {"quality": quality, "splats": len(store), "in_view": counts[-1] if counts else None}
            row |= {"drawn": frame.stats["splats"], "pairs": frame.stats["pairs"]}
            row |= {"s": time.perf_counter() - begun, "cpu_s": time.process_time() - cpu}
            rows.append(row)
            PROGRESS.print(f"{quality}: {row['drawn']:,} of {row['in_view']}, {row['s']:.2f} s")
    finally:
        OcclusionCulling.render = drawn
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=4e6)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--places", type=int, default=50)
    parser.add_argument("--views", type=int, default=12)
    parser.add_argument("--step", type=float, default=0.5, help="metres from view to view")
    parser.add_argument("--qualities", nargs="+", default=["standard"])
    parser.add_argument("--memory-budget", type=float, default=9e9)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--folder", default="fidsplat-stores", help="where stores are kept")
    asked = parser.parse_args()
    city, folder = City(int(asked.splats), asked.houses), Path(asked.folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = path_of(city, folder)
    if not path.exists():
        fs.build_store([city.source], path)
    renderer = fs.Renderer(asked.device, int(asked.memory_budget))
    store = fs.Store(path)
    if any("detail_error" in quality for quality in asked.qualities) and not store.detail_errors:
        measure_detail(store, renderer)
    store = placed(fs.Store(path), city, asked.places, folder)
    width, height = map(int, asked.size.split("x"))
    shots = cameras(store, (width, height), asked.views, asked.step)
    rows = [row for quality in asked.qualities for row in drive(renderer, store, quality, shots)]
    for quality in asked.qualities:
        own = [row for row in rows if row["quality"] == quality][1:]
        for name in ("drawn", "s", "cpu_s"):
            PROGRESS.print(f"{quality}: median {name} {np.median([row[name] for row in own]):,.2f}")
    keep({**facts(renderer), "rows": rows}, asked.json)


if __name__ == "__main__":
    main()
