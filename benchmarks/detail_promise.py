"""Whether levels of detail keep their promise: errors of 200 views along a path, and how far pictures jump.

    python benchmarks/detail_promise.py [--splats 4e5] [--views 200] [--size 160x90] [--json FILE]

Builds a city (`fidsplat.worlds.city`), measures its levels of detail from other places, then flies a path
that turns around it and away from it, from a fifth of its side to a hundred sides. For each allowed error: of
how many views the largest error of rgb is within it; splats and time of a view beside the exact picture's;
and the largest jump, by how much the error of a pixel changes from one view to the next.
"""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.accuracy.detail_errors import measure_detail
from fidsplat.accuracy.error import REFERENCE_CUTOFF
from fidsplat.worlds.city import City

ERRORS = (1 / 255, 4 / 255)


def path_around(side: float, views: int, size: tuple[int, int], low: bool = False) -> list[fs.Camera]:
    """Cameras on a spiral away from a city of this side [m]. low: near the ground, from where streets are
    seen between houses."""
    middle, cameras = np.array([side / 2, 0.0, side / 2]), []
    for number in range(views):
        share = number / max(views - 1, 1)
        away, turn, up = side * 0.2 * 500**share, 4 * math.pi * share, 0.3 + 0.4 * share
        if low:
            away, turn = side * 0.3 * 200**share, 4.6 * math.pi * share + 0.3
            up = 0.12 + 0.1 * math.sin(9 * share)
        at = middle + away * np.array([math.cos(turn), -up, math.sin(turn)])
        cameras.append(fs.Camera.look_at(*size, math.radians(60), at, middle - np.array([0, 5, 0])))
    return cameras


def measure(store: fs.Store, cameras: list[fs.Camera], renderer: fs.Renderer) -> list[dict]:
    """Of each allowed error, and of the exact pictures, a row."""
    base = fs.Quality(lowpass="pixel", alpha_cutoff=REFERENCE_CUTOFF)
    resident, errors = renderer.upload(store), (0.0, *ERRORS)
    rows = {error: {"allowed": error, "errors": [], "splats": [], "s": [], "jump": 0.0} for error in errors}
    before: dict[float, np.ndarray] = {}
    for number, camera in enumerate(cameras):
        exact = np.empty(0)
        for error, row in rows.items():
            capture = fs.Capture(camera, quality=base.with_(detail_error=error))
            begun = time.perf_counter()
            frame = renderer.render(resident, capture)
            picture = frame["rgb"].astype(np.float64)
            row["s"].append(time.perf_counter() - begun)
            row["splats"].append(frame.stats["splats"])
            exact = exact if error else picture
            off = picture - exact
            row["errors"].append(float(np.abs(off).max()))
            if error in before:
                row["jump"] = max(row["jump"], float(np.abs(off - before[error]).max()))
            before[error] = off
        if number % 20 == 0:
            PROGRESS.print(f"view {number} of {len(cameras)}")
    return list(rows.values())


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=4e5)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0, help="of the city")
    parser.add_argument("--low", action="store_true", help="a path low over the ground")
    parser.add_argument("--views", type=int, default=200)
    parser.add_argument("--measured", type=int, default=60, help="views that errors are measured with")
    parser.add_argument("--size", default="160x90")
    parser.add_argument("--chunk", type=int, default=4096, help="splats of a chunk; small, as the city is")
    asked = parser.parse_args()
    width, height = map(int, asked.size.split("x"))
    city, renderer = City(int(asked.splats), asked.houses, asked.seed), fs.Renderer(asked.device)
    with tempfile.TemporaryDirectory() as folder:
        path = fs.build_store([city.source], Path(folder) / "city.fss", chunk=asked.chunk)
        store = fs.Store(path)
        details = measure_detail(store, renderer, asked.measured)
        rows = measure(store, path_around(city.side, asked.views, (width, height), asked.low), renderer)
    exact = np.mean(rows[0]["s"])
    about = {**facts(renderer), "splats": len(store), "views": asked.views, "size": [width, height]}
    keep({**about, "details": [vars(one) for one in details], "rows": rows}, asked.json)
    show(
        f"{len(store):,} splats, {asked.views} views of {width} x {height}, {about['device']}",
        ("error allowed", "kept", "largest", "median", "splats", "time of exact", "largest jump"),
        (
            (
                f"{row['allowed']:.4f}",
                f"{np.mean(np.array(row['errors']) <= row['allowed']):.1%}",
                f"{max(row['errors']):.4f}",
                f"{np.median(row['errors']):.4f}",
                f"{np.mean(row['splats']):,.0f}",
                f"{np.mean(row['s']) / exact:.2f}",
                f"{row['jump']:.4f}",
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
