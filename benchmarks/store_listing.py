"""Two ways to list a store on a GPU, in turns: by work-groups that count in local memory, and pair by pair.

    python benchmarks/store_listing.py [--splats 20e6] [--places 50 5] [--size 3840x2160] [--json FILE]

The city of benchmarks/store_views.py without levels of detail, exact; of each number of places its views,
and of more than 1e8 splats the first alone. The camera moves by 1 % of its height from picture to picture.
Seconds end with float32 rgb on the host; stages are those of the last picture. Both ways must give the same
bits.
"""

from __future__ import annotations

import time
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest import mock

from measuring import PROGRESS, facts, keep, options, show
from store_views import further, placed, views

import fidsplat as fs
from fidsplat.backends.opencl import chunks
from fidsplat.store.city import City


class PairByPair(chunks.GatheredChunks):
    """Listed as splats in any order are."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.neighbours = False


WAYS = {"by work-group": chunks.GatheredChunks, "pair by pair": PairByPair}


def measure(renderer: fs.Renderer, store: fs.Store, cameras: list[fs.Camera], way: str) -> dict:
    """Of each picture its seconds and the digest of its rgb; stages and counts of the last."""
    with mock.patch.object(chunks, "GatheredChunks", WAYS[way]):
        resident = renderer.upload(store)
        row: dict = {"splats": len(store), "way": way, "s": [], "rgb": []}
        for camera in cameras:
            begun = time.perf_counter()
            frame = renderer.render(resident, camera)
            rgb = frame["rgb"]
            row["s"].append(time.perf_counter() - begun)
            row["rgb"].append(sha256(rgb.tobytes()).hexdigest())
            row |= {"ms": dict(frame.timings), "stats": dict(frame.stats)}
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--places", type=int, nargs="+", default=[50, 5])
    parser.add_argument("--size", default="3840x2160")
    parser.add_argument("--pictures", type=int, default=4, help="of each view, one after another")
    parser.add_argument("--folder", default="fidsplat-stores", help="where stores are kept")
    asked = parser.parse_args()
    city, folder = City(int(asked.splats), asked.houses), Path(asked.folder)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"plain-{int(asked.splats)}-{asked.houses}.fss"
    if not path.exists():
        fs.build_store([city.source], path, levels=False)
    renderer, rows = fs.Renderer(asked.device), []
    width, height = map(int, asked.size.split("x"))
    for places in asked.places:
        store = placed(fs.Store(path), city, places, folder)
        for name, camera in views(store, (width, height)).items():
            if len(store) > 1e8 and name != "all":
                continue
            cameras = [camera]
            while len(cameras) < asked.pictures:
                cameras.append(further(cameras[-1]))
            each = [{"view": name, **measure(renderer, store, cameras, way)} for way in WAYS]
            for row in each:
                row["same"] = row["rgb"] == each[0]["rgb"]
                PROGRESS.print(f"{len(store):,} {name} {row['way']}: {row['s']}")
            rows += each
            keep({**facts(renderer), "size": asked.size, "rows": rows}, asked.json)
    show(
        f"{renderer.device.title}, {asked.size}",
        ("splats", "view", "listed", "first [s]", "next [s]", "project, bin, sort, blend [ms]", "same bits"),
        (
            (
                f"{row['splats']:,}",
                row["view"],
                row["way"],
                f"{row['s'][0]:.3f}",
                f"{min(row['s'][1:]):.3f} to {max(row['s'][1:]):.3f}",
                ", ".join(f"{row['ms'][stage]:.1f}" for stage in ("project", "bin", "sort", "blend")),
                str(row["same"]),
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
