"""Two devices over one: many views, and one picture of one scene.

    python benchmarks/several_gpus.py [--devices opencl:nvidia opencl:nvidia-2] [--splats 20e6] [--json FILE]

Builds a city (`fidsplat.store.city`), loads it as a cloud and as a store, and draws it from above and from a
street with the first device alone, then with all of them (`fs.SeveralDevices`): a number of views, each whole
by one device, and single pictures, each in bands of rows. Without --devices: all of the best one's kind, or
that one twice. Times are medians of --rounds pictures with their rgb on the host; every picture is compared
with that of one device, byte by byte. The model says what more devices would give: the time of a band of one
row stays, and the rest is shared out.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from store_views import further, placed, views

import fidsplat as fs
from fidsplat.store.city import City

MODELLED = (2, 4, 8, 64)


def seconds(work: Callable[[int], object], rounds: int) -> float:
    """The median of so many calls, after two that are not counted."""
    taken = []
    for number in range(rounds + 2):
        begun = time.perf_counter()
        work(number)
        taken.append(time.perf_counter() - begun)
    return float(np.median(taken[2:]))


def measure(
    scene: fs.Store | fs.SplatCloud, camera: fs.Camera, several: fs.SeveralDevices, rounds: int
) -> dict:
    """Seconds of a picture and of views, by one device and by all, and whether the bits are the same."""
    one, on_all = several.renderers[0], several.upload(scene)
    cameras = [camera]
    for _ in range(rounds + 1):
        cameras.append(further(cameras[-1]))
    row: dict = {"splats": len(scene)}
    row["picture_s"] = [
        seconds(lambda k: one.render(on_all[0], cameras[k])["rgb"], rounds),
        seconds(lambda k: several.render(on_all, cameras[k])["rgb"], rounds),
    ]
    middle = camera.height // 2

    def row_alone(k: int) -> np.ndarray:
        frame = one.render_band((middle, middle + 1), on_all[0], cameras[k])
        return frame.read_rows("rgb", middle, middle + 1)[middle]

    thin = seconds(row_alone, rounds)
    alone = row["picture_s"][0]
    row["row_s"], row["model"] = thin, {n: alone / (thin + (alone - thin) / n) for n in MODELLED}
    # a device's first pictures of a kind are planned, and its lists grow: not what is asked
    for frame in several.render_views(on_all, cameras[:1] * (3 * len(on_all))):
        _ = frame["rgb"]
    spent = []
    for frames in (one.render_views(on_all[0], cameras), several.render_views(on_all, cameras)):
        begun = time.perf_counter()
        for frame in frames:
            _ = frame["rgb"]
        spent.append(time.perf_counter() - begun)
    row["views_s"] = [total / len(cameras) for total in spent]
    wanted = one.render(on_all[0], camera)["rgb"]
    row["same"] = bool(np.array_equal(several.render(on_all, camera)["rgb"], wanted))
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--devices", nargs="+", help="all of one kind")
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--places", type=int, default=1, help="of the city, so many times")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--views", nargs="+", default=["all", "roofs", "street"], help="of these three")
    parser.add_argument("--size", default="3840x2160")
    asked = parser.parse_args()
    first = fs.Renderer(asked.device)
    found = [one.name for one in fs.devices() if one.title == first.device.title and "opencl" in one.name]
    names = asked.devices or (found if len(found) > 1 else [first.device.name] * 2)
    several, city = fs.SeveralDevices(names), City(int(asked.splats))
    width, height = map(int, asked.size.split("x"))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        store = fs.Store(fs.build_store([city.source], Path(folder) / "city.fss", levels=False))
        store = placed(store, city, asked.places, Path(folder))
        for view, camera in views(store, (width, height)).items():
            if view not in asked.views:
                continue
            for kind, scene in (("store", store), ("cloud", store.cloud())):
                row = {"view": view, "scene": kind, **measure(scene, camera, several, asked.rounds)}
                rows.append(row)
                PROGRESS.print(str(row))
                keep({**facts(first), "devices": names, "size": asked.size, "rows": rows}, asked.json)
    show(
        f"{len(names)} x {first.device.title}, {rows[0]['splats']:,} splats, {asked.size}",
        ("scene", "view", "one [ms]", "all [ms]", "picture", "views", "model 2/4/8/64", "same bits"),
        (
            (
                row["scene"],
                row["view"],
                f"{1e3 * row['picture_s'][0]:.1f}",
                f"{1e3 * row['picture_s'][1]:.1f}",
                f"{row['picture_s'][0] / row['picture_s'][1]:.2f}",
                f"{row['views_s'][0] / row['views_s'][1]:.2f}",
                " ".join(f"{gain:.1f}" for gain in row["model"].values()),
                str(row["same"]),
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
