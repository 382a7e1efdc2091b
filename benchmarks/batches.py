"""Time batches of views and the same views rendered one by one, and check that they are bit-identical.

    python benchmarks/batches.py --device opencl [--rows scenes agents few] [--repeats 5] [--json FILE]

Splats and images stay on the device. Times are per view, from the call until the device has finished; `host`
is the time until the call returns. Cameras are on an arc around their target.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from measuring import PROGRESS, facts, keep, options, show

import fidsplat as fs
from fidsplat.capture.views import CaptureBatch, pose_matrices
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.scenes.random_clouds import load_scene
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.util.timing import Timer


@dataclass(frozen=True)
class Row:
    """Settings of one batch."""

    views: int
    splats: int
    width: int
    height: int
    outputs: tuple[str, ...]


ROWS = {
    "scenes": Row(1024, 100_000, 640, 480, ("rgb", "depth", "label")),
    "agents": Row(4096, 10_000, 128, 128, ("rgb",)),
    "few": Row(64, 10_000, 128, 128, ("rgb",)),
}
"""batches by name; `few` is for CPUs"""
ARRAYS = ("means", "quats", "scales", "opacities", "colors")
_ALONE = 32
"""number of views that are rendered one by one and compared"""


def arc(views: int) -> np.ndarray:
    """Poses (views, 7) on a quarter circle with a radius of 6 metres around a point 6 metres ahead."""
    target, poses = np.array([0.0, 0.0, 6.0]), []
    for angle in np.linspace(-np.pi / 4, np.pi / 4, views):
        position = target - 6.0 * np.array([np.sin(angle), 0.0, np.cos(angle)])
        turn = fs.Camera.look_at(8, 8, 1.0, position, target).world_to_camera[:3, :3].T
        poses.append([*position, *matrix_to_quaternion(turn)])
    return np.array(poses)


def scene_of(row: Row) -> tuple[fs.SplatCloud, fs.Capture, np.ndarray]:
    """Splats, capture and poses of a batch."""
    every = load_scene("r100k_720p")[0]
    some = {field: getattr(every, field)[: row.splats] for field in ARRAYS}
    cloud = fs.SplatCloud(**some, labels=np.arange(row.splats) % 50)
    focal = row.width / 2 / np.tan(0.5)
    camera = fs.Camera.pinhole(row.width, row.height, focal, focal, row.width / 2, row.height / 2)
    return cloud, fs.Capture(camera, row.outputs, TIMED), arc(row.views)


def measure(renderer: fs.Renderer, name: str, repeats: int) -> dict:
    """Measured figures of a row, per view."""
    row = ROWS[name]
    cloud, capture, poses = scene_of(row)
    resident = renderer.upload(cloud)
    host: list[float] = []

    def draw() -> fs.FrameBatch:
        begun = time.perf_counter()
        batch = renderer.render_batch(resident, capture, poses=poses)
        host.append(1e3 * (time.perf_counter() - begun))
        return batch.wait()

    timer = Timer(draw, parts=lambda batch: batch.timings)
    for number in range(repeats + 2):
        timer.run(timed=number > 1)
    batch = draw()
    some = np.linspace(0, row.views - 1, min(_ALONE, row.views)).astype(int)
    captures = [CaptureBatch((capture,), pose_matrices("poses", poses[[k]])).capture(0) for k in some]
    single = Timer(lambda: [renderer.render(resident, each) for each in captures][-1].wait())
    for number in range(3):
        single.run(timed=number > 0)
    for k, each in zip(some, captures, strict=True):
        frame, view = renderer.render(resident, each), batch.frame(int(k))
        assert all(np.array_equal(frame[output], view[output]) for output in row.outputs), k
    low, middle, high = (1e3 * each / row.views for each in timer.quartiles)
    return {
        "batch": name,
        **{"views": row.views, "splats": row.splats, "width": row.width, "height": row.height},
        "outputs": list(row.outputs),
        **facts(renderer),
        **{"us_per_view": middle, "quartiles_us": [low, high], "repeats": repeats},
        "host_us_per_view": 1e3 * float(np.median(host[2:])) / row.views,
        "stages_us": {stage: 1e3 * ms / row.views for stage, ms in timer.part_medians.items()},
        "alone_us_per_view": 1e3 * single.median / len(some),
        "pairs_per_view": batch.stats["pairs"] / row.views,
    }


def main() -> None:
    parser = options(__doc__, repeats=5)
    parser.add_argument("--rows", nargs="*", default=["few"], choices=[*ROWS], metavar="ROW")
    arguments = parser.parse_args()
    renderer, rows = fs.Renderer(arguments.device), []
    for name in arguments.rows:
        with PROGRESS.status(f"rendering {name}"):
            rows.append(measure(renderer, name, max(arguments.repeats, 1)))
    if keep(rows, arguments.json):
        return

    def cells(row: dict) -> tuple[str, ...]:
        size = f"{row['width']} x {row['height']}"
        figures = (row["us_per_view"], row["host_us_per_view"], row["alone_us_per_view"])
        return f"{row['views']} x {size}", f"{row['splats']:,}", *(f"{figure:.1f}" for figure in figures)

    show(
        f"us per view on {renderer.device.title}",
        ("views", "splats", "batch", "host", "one by one"),
        map(cells, rows),
    )


if __name__ == "__main__":
    main()
