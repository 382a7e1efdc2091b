"""Views of a store, one after another, exact at the default quality: seconds of each, and of its stages.

    python benchmarks/store_exact.py [--splats 20e6] [--places 50] [--size 3840x2160] [--json FILE]

The city of benchmarks/store_views.py without levels of detail, at so many places, from above all of it; the
camera then moves by 1 % of its height from view to view. A time ends with float32 rgb on the host. The
counts are sums over the bands that a picture is drawn in: a splat that two bands see counts twice.
"""

from __future__ import annotations

import time
from pathlib import Path

from measuring import PROGRESS, facts, keep, options, show
from store_views import further, placed, views

import fidsplat as fs
from fidsplat.store.city import City


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--places", type=int, default=50)
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--views", type=int, default=5, help="how many, one after another")
    parser.add_argument("--folder", default="fidsplat-stores", help="where stores are kept")
    asked = parser.parse_args()
    city, folder = City(int(asked.splats), asked.houses), Path(asked.folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"plain-{int(asked.splats)}-{asked.houses}.fss"
    if not path.exists():
        fs.build_store([city.source], path, levels=False)
    store = placed(fs.Store(path), city, asked.places, folder)
    renderer, rows = fs.Renderer(asked.device), []
    resident = renderer.upload(store)
    width, height = map(int, asked.size.split("x"))
    camera = views(store, (width, height))["all"]
    for number in range(asked.views):
        begun = time.perf_counter()
        frame = renderer.render(resident, camera)
        _ = frame["rgb"]
        row = {"s": time.perf_counter() - begun, "ms": dict(frame.timings), "stats": dict(frame.stats)}
        rows.append({**row, "device_bytes": resident.memory_bytes})
        PROGRESS.print(f"view {number}: {row['s']:.2f} s")
        keep({**facts(renderer), "splats": len(store), "size": asked.size, "rows": rows}, asked.json)
        camera = further(camera)
    stages = list(rows[0]["ms"]) if rows else []
    show(
        f"{renderer.device.title}, {len(store):,} splats, {asked.size}",
        ("view", "seconds", *(f"{stage} [ms]" for stage in stages)),
        (
            (str(number), f"{row['s']:.2f}", *(f"{row['ms'][stage]:.0f}" for stage in stages))
            for number, row in enumerate(rows)
        ),
    )


if __name__ == "__main__":
    main()
