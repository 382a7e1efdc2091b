"""Measure frames of stores: splats read, time, error and memory.

    python benchmarks/store_views.py [--splats 20e6] [--places 1 5 50] [--errors 0.004 0.016] [--json FILE]

Builds a city once (`fidsplat.worlds.city`, cached in --folder), measures its levels of detail, and places it
on a grid. For each number of instances there are three views, from an overview to a street. Reported for each
view and allowed error: seconds of the first frame, of the next view (moved by 1 % of the distance) and of
that view repeated; numbers of rendered splats and nodes; the maximum difference from the exact frame, which
is rendered if at most --exact splats are visible; device memory and peak memory of the process. --path adds
the milliseconds of the views of a path through these views. `standard` are exact frames at the default
quality, with frustum culling only.
"""

from __future__ import annotations

import math
import resource
import time
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.accuracy.detail_errors import measure_detail
from fidsplat.accuracy.error import REFERENCE_CUTOFF
from fidsplat.backends.prepare import prepare
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.streaming.level_of_detail import select
from fidsplat.worlds.city import City


def path_of(city: City, folder: Path) -> Path:
    """Path of the city's store."""
    return folder / f"city-{city.splats}-{city.houses}.fss"


def placed(store: fs.Store, city: City, places: int, folder: Path) -> fs.Store:
    """Store with instances of the city on a grid of streets."""
    if places == 1:
        return store
    side = math.ceil(math.sqrt(places))
    poses = np.tile(np.eye(4), (places, 1, 1))
    numbers = np.arange(places)
    poses[:, 0, 3], poses[:, 2, 3] = numbers % side * city.side, numbers // side * city.side
    return fs.Store(fs.place_store(store, folder / f"city-{places}.fss", poses, overwrite=True))


def views(store: fs.Store, size: tuple[int, int]) -> dict[str, fs.Camera]:
    """Cameras of three views: an overview, above the roofs at one side, and in a street."""
    low, high = store.bounds()
    middle, side = (low + high) / 2, float((high - low).max())
    street = np.array([middle[0], -1.7, low[2] - 4.0])
    at = {
        "all": middle + side * np.array([0.0, -0.9, -1.1]),
        "roofs": np.array([middle[0], -60.0, low[2] - 40.0]),
        "street": street,
    }
    towards = {"all": middle, "roofs": middle, "street": street + np.array([0, 0, 50.0])}
    return {name: fs.Camera.look_at(*size, math.radians(60), at[name], towards[name]) for name in at}


def further(camera: fs.Camera) -> fs.Camera:
    """The camera moved by 1 % of its height above the ground."""
    pose = camera.world_to_camera.copy()
    pose[0, 3] += 0.01 * abs(camera.position[1])
    return camera.with_pose(pose)


def timed(renderer: fs.Renderer, resident, capture: fs.Capture) -> tuple[np.ndarray, list[float], dict]:
    """Render a view, the next view, and the next view again; returns the first image, the seconds of each,
    and the counts of the last frame."""
    seconds, images, frame = [], [], None
    next_view = capture.with_(camera=further(capture.camera))
    for one in (capture, next_view, next_view):
        begun = time.perf_counter()
        frame = renderer.render(resident, one)
        images.append(frame["rgb"])
        seconds.append(time.perf_counter() - begun)
    assert frame is not None
    return images[0], seconds, dict(frame.stats)


def along(store: fs.Store, renderer: fs.Renderer, arguments, error: float) -> dict:
    """Milliseconds of each view of a path from the overview to the street."""
    width, height = map(int, arguments.size.split("x"))
    size = width, height
    places = [camera.position for camera in views(store, size).values()]
    towards = np.mean(store.bounds(), axis=0)
    shares = np.linspace(0, len(places) - 1, arguments.path)
    steps = np.column_stack([np.interp(shares, range(len(places)), axis) for axis in np.transpose(places)])
    quality = fs.Quality(lowpass="pixel", alpha_cutoff=REFERENCE_CUTOFF, detail_error=error)
    cameras = [fs.Camera.look_at(*size, math.radians(60), at, towards) for at in steps]
    made, begun = [], time.perf_counter()
    for frame in renderer.render_views(renderer.upload(store), cameras, quality=quality):
        _ = frame["rgb"]
        made.append((1e3 * (time.perf_counter() - begun), frame.stats["splats"]))
        begun = time.perf_counter()
    times, splats = np.transpose(made)
    PROGRESS.print(f"path, {error:.4f}: median {np.median(times):.0f} ms, largest {times.max():.0f} ms")
    return {"error": error, "splats": len(store), "ms": times.tolist(), "rendered": splats.tolist()}


def measure(store: fs.Store, renderer: fs.Renderer, arguments) -> list[dict]:
    """A row for each view and allowed error."""
    rows, splats = [], ChunkedSplats([store])
    width, height = map(int, arguments.size.split("x"))
    for name, camera in views(store, (width, height)).items():
        if name not in arguments.views:
            continue
        exact = None
        for error in ("standard", 0.0, *arguments.errors):
            quality = fs.Quality()
            if error != "standard":
                quality = fs.Quality(lowpass="pixel", alpha_cutoff=REFERENCE_CUTOFF, detail_error=error)
            capture = fs.Capture(camera, quality=quality)
            features, view = prepare(splats, capture)
            begun = time.perf_counter()
            selection = select(splats, [view], features, splats.cell_sizes(quality))
            chosen = time.perf_counter() - begun
            visible = sum(int(store.counts(np.array(nodes)).sum()) for nodes in selection.nodes if nodes)
            row = {"view": name, "splats": len(store), "error": error, "rendered": visible}
            row |= {"nodes": len(selection), "choose_s": chosen}
            if visible <= arguments.exact:
                resident = renderer.upload(store)
                image, row["s"], row["stats"] = timed(renderer, resident, capture)
                row["device_bytes"] = resident.memory_bytes
                exact = image if error == 0 else exact
                if exact is not None:
                    row["off"] = float(np.abs(image - exact).max())
            row["peak_bytes"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
            rows.append(row)
            PROGRESS.print(f"{len(store):,} {name} {error}: {visible:,} splats, {row.get('s')}")
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--splats", type=float, default=20e6)
    parser.add_argument("--houses", type=int, default=8)
    parser.add_argument("--places", type=int, nargs="+", default=[1, 5, 50])
    parser.add_argument("--errors", type=float, nargs="+", default=[1 / 255, 4 / 255])
    parser.add_argument(
        "--exact", type=float, default=1e8, help="maximum number of visible splats of exact frames"
    )
    parser.add_argument("--views", nargs="+", default=["all", "roofs", "street"], help="of these three")
    parser.add_argument("--path", type=int, default=0, help="views of a path, for each error")
    parser.add_argument("--measured", type=int, default=8, help="views that errors are measured with")
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--folder", default="fidsplat-stores", help="folder of the stores")
    arguments = parser.parse_args()
    city, folder = City(int(arguments.splats), arguments.houses), Path(arguments.folder)
    folder.mkdir(parents=True, exist_ok=True)
    path, built = path_of(city, folder), None
    renderer = fs.Renderer(arguments.device)
    if not path.exists():
        begun, cpu = time.perf_counter(), time.process_time()
        fs.build_store([city.source], path)
        built = {"s": time.perf_counter() - begun, "cpu_s": time.process_time() - cpu}
        PROGRESS.print(f"built: {built}")
    store = fs.Store(path)
    if not store.detail_errors:
        measure_detail(store, renderer, arguments.measured)
    rows, paths = [], []
    about = {**facts(renderer), "built": built, "bytes": store.nbytes, "size": arguments.size}
    about["details"] = [vars(one) for one in store.detail_errors]
    for places in arguments.places:
        whole = placed(store, city, places, folder)
        rows += measure(whole, renderer, arguments)
        paths += [along(whole, renderer, arguments, error) for error in arguments.errors if arguments.path]
        keep({**about, "rows": rows, "paths": paths}, arguments.json)
    show(
        f"{about['device']}, {arguments.size}",
        (
            "splats",
            "view",
            "error",
            "rendered",
            "first [s]",
            "next [s]",
            "same [s]",
            "off by",
            "device",
            "peak",
        ),
        (
            (
                f"{row['splats']:,}",
                row["view"],
                f"{row['error']:.4}",
                f"{row['rendered']:,}",
                *(f"{value:.2f}" for value in row.get("s", ())),
                *([] if "s" in row else ["-", "-", "-"]),
                f"{row['off']:.4f}" if "off" in row else "-",
                f"{row.get('device_bytes', 0) / 2**30:.2f} GiB",
                f"{row['peak_bytes'] / 2**30:.2f} GiB",
            )
            for row in rows
        ),
    )


if __name__ == "__main__":
    main()
