"""Pictures of a store, one after another, each of another view: seconds of each, of its stages, and memory.

    python benchmarks/store_pictures.py [--splats 20e6] [--places 50] [--size 3840x2160] [--json FILE]
    python benchmarks/store_pictures.py --error 0.0039 ...

The city of benchmarks/store_views.py at so many places, from above all of it; the camera then moves by 1 % of
its height from view to view. Exact at the default quality; with --error by levels of detail, which are
measured once for the city (`lowpass="pixel"`). A time ends with float32 rgb on the host. The counts are sums
over the bands that a picture is drawn in: a splat that two bands see counts twice.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path

from measuring import PROGRESS, facts, keep, options, show
from store_views import further, placed, views

import fidsplat as fs
from fidsplat.accuracy import TRUTH_CUTOFF
from fidsplat.detail import measure_detail
from fidsplat.store.city import City


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--places", type=int, default=50)
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--error", type=float, default=0.0, help="of rgb that is allowed; 0: exact")
    parser.add_argument("--measured", type=int, default=24, help="views that errors are measured with")
    parser.add_argument("--views", type=int, default=5, help="how many, one after another")
    parser.add_argument("--memory-budget", type=float, help="bytes of the device")
    parser.add_argument("--folder", default="fidsplat-stores", help="where stores are kept")
    asked = parser.parse_args()
    city, folder = City(int(asked.splats), asked.houses), Path(asked.folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{'city' if asked.error else 'plain'}-{int(asked.splats)}-{asked.houses}.fss"
    if not path.exists():
        fs.build_store([city.source], path, levels=asked.error > 0)
    budget = None if asked.memory_budget is None else int(asked.memory_budget)
    renderer, rows, quality = fs.Renderer(asked.device, budget), [], fs.Quality()
    store = fs.Store(path)
    if asked.error:
        quality = fs.Quality(lowpass="pixel", alpha_cutoff=TRUTH_CUTOFF, detail_error=asked.error)
        if not store.details:
            measure_detail(store, renderer, asked.measured)
    store = placed(store, city, asked.places, folder)
    resident = renderer.upload(store)
    width, height = map(int, asked.size.split("x"))
    camera = views(store, (width, height))["all"]
    for number in range(asked.views):
        begun = time.perf_counter()
        frame = renderer.render(resident, camera, quality=quality)
        _ = frame["rgb"]
        row = {"s": time.perf_counter() - begun, "ms": dict(frame.timings), "stats": dict(frame.stats)}
        row["peak_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        rows.append({**row, "device_bytes": resident.memory_bytes})
        PROGRESS.print(f"view {number}: {row['s']:.2f} s of {row['stats']['splats']:,} splats")
        about = {"splats": len(store), "error": asked.error, "size": asked.size}
        keep({**facts(renderer), **about, "rows": rows}, asked.json)
        camera = further(camera)
    stages = list(rows[0]["ms"]) if rows else []
    show(
        f"{renderer.device.title}, {len(store):,} splats, {asked.size}, error {asked.error:g}",
        ("view", "seconds", "splats drawn", *(f"{stage} [ms]" for stage in stages), "process"),
        (
            (
                str(number),
                f"{row['s']:.2f}",
                f"{row['stats']['splats']:,}",
                *(f"{row['ms'][stage]:.0f}" for stage in stages),
                f"{row['peak_bytes'] / 2**30:.1f} GiB",
            )
            for number, row in enumerate(rows)
        ),
    )


if __name__ == "__main__":
    main()
