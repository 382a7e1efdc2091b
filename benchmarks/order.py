"""Measure how pixels jump when splats change order, and what the order by pixel costs (docs/correctness.md).

    python benchmarks/order.py [--device opencl] [--scene FILE] [--repeats 15] [--rows NAME ...] [--cpu-time]
        [-o docs/images/order-jump.png] [--json FILE] [--times-only | --jumps-only]

Jumps: the largest change of a pixel while a camera rotates in steps of 1e-4 degrees, with splats ordered by
the depth of their centres and by depth at each pixel, and after shuffling the splats. Scenes at 240 x 192
pixels: markers of Gaussians, one of them 5 cm in front of a wall of 2000 splats without coplanar group, 1000
splats that intersect, and the captured scene of --scene. The 20 steps are around the view in which the
centres of a fronto-parallel marker change order. The image shows a QR code before and after the worst step.
For `pixel`, the float64 reference renders the 16 pixels with the largest jumps along the same path. Reported
are its jumps and how far ours exceed them in the same or an adjacent step, since rounding may move an edge
past a pixel one step earlier.

Times: frames of the standard scenes, of a default marker in front of the wall and of the intersecting splats
(30 degrees, 1280 x 720), of --scene, and of --scene with a marker behind a fisheye lens (640 x 480). All
orders are timed interleaved with resident splats, at the standard cut-off and at 1/255; reported are the
medians and, for `pixel` and `auto`, the median and quartiles of the ratio to `centre`. Without coplanar
groups `auto` is `centre`. --cpu-time: processor time of the process in place of wall-clock time, for CPUs
that others use too.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from measuring import PROGRESS, facts, keep, options, show
from real_scene import extent, views
from rich.progress import track

import fidsplat as fs
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import contact_sheet
from fidsplat.scenes.random_clouds import load_scene, random_splats
from fidsplat.selftest.agreement import FrameSpec, reference_images, render
from fidsplat.selftest.clouds import subset_of
from fidsplat.selftest.order import STEP, camera_path, largest_jump, wall
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved

ORDERS = ("centre", "pixel")
TIMED_ORDERS = ("centre", "auto", "pixel")
SIZE = {"width": 240, "height": 192}
STEPS = 10
REFERENCE_PIXELS = 16
"""pixels of a scene that the reference renders"""
CUTOFFS = {"standard": 1e-5, "1/255": 1 / 255}
TIMED = ("r100k_720p", "r1m_1080p")
INTERSECTING = "1000 splats that intersect"
WITH_MARKER = "captured with AprilTag, fisheye"


def marker(spec: str) -> fs.SplatCloud:
    """A marker of Gaussians, 1 m wide."""
    return fs.marker(spec, size=1.0, mixture="fitted").cloud


def tilted_clouds() -> dict[str, tuple[fs.SplatCloud, float]]:
    """Clouds around the origin with their tilt in degrees."""
    tag, intersecting = (
        marker("apriltag:36h11:5"),
        random_splats(1000, 3, (-0.5, 0.5), (0.05, 0.4), across=1.0),
    )
    before_wall = fs.SplatCloud.concatenate([tag, wall()])
    return {
        "AprilTag 36h11": (tag, 0.0),
        "QR 5": (marker("qr-v5-L:fidsplat"), 0.0),
        **{f"AprilTag before a wall, {tilt:g} deg": (before_wall, tilt) for tilt in (0.0, 30.0, 60.0)},
        INTERSECTING: (intersecting, 30.0),
    }


def around_capture(cloud: fs.SplatCloud, order: str) -> Iterator[FrameSpec]:
    """Frames of a captured scene while the camera orbits it, centred on the front view."""
    low, high = extent(cloud)
    middle, front = (low + high) / 2, views(cloud)["front"].position
    for number in range(-STEPS, STEPS + 1):
        angle = number * STEP
        offset = front - middle
        c, s = math.cos(angle), math.sin(angle)
        position = middle + np.array(
            [c * offset[0] + s * offset[2], offset[1], c * offset[2] - s * offset[0]]
        )
        camera = fs.Camera.look_at(SIZE["width"], SIZE["height"], math.radians(60), position, middle)
        yield FrameSpec(cloud, camera, fs.Quality(order=order), ("rgb",))


def compare_reference(renderer: fs.Renderer, specs: list[FrameSpec]) -> dict:
    """Largest jump of the reference at the pixels with the largest jumps, and how far ours exceed it."""
    rendered = np.stack([render(renderer, spec)["rgb"] for spec in specs])
    largest = np.abs(np.diff(rendered, axis=0)).max((0, 3))
    at = np.unravel_index(np.argsort(-largest, axis=None)[:REFERENCE_PIXELS], largest.shape)
    reference = np.stack([reference_images(spec, at)["rgb"] for spec in specs])
    ours, expected = (np.abs(np.diff(rgb, axis=0)).max(2) for rgb in (rendered[:, *at], reference))
    padded = np.pad(expected, ((1, 1), (0, 0)))
    allowed = np.max([padded[:-2], expected, padded[2:]], axis=0)
    return {"step_reference": float(expected.max()), "beyond_reference": float((ours - allowed).max())}


def jump_of(order: str, found: tuple[float, np.ndarray, np.ndarray]) -> dict:
    """Largest change of a pixel in the worst step, and number of changes above 1/255."""
    jump, before, after = found
    return {f"step_{order}": jump, f"pixels_{order}": int((np.abs(after - before).max(2) > 1 / 255).sum())}


def jumps(renderer: fs.Renderer, capture: fs.SplatCloud | None, panels: dict) -> list[dict]:
    """A row for each scene. The worst steps are written to `panels`."""
    rows = []
    for name, (cloud, tilt) in track(tilted_clouds().items(), "jumps", console=PROGRESS):
        shuffled = subset_of(cloud, np.random.default_rng(0).permutation(len(cloud)))
        row = {"scene": name, "splats": len(cloud)}
        for order in ORDERS:
            found = largest_jump(renderer, camera_path(cloud, order, STEPS, tilt, **SIZE))
            original, reordered = (
                next(camera_path(one, order, 0, tilt, **SIZE)) for one in (cloud, shuffled)
            )
            change = np.abs(render(renderer, original)["rgb"] - render(renderer, reordered)["rgb"]).max()
            row |= jump_of(order, found) | {f"shuffle_{order}": float(change)}
            panels[name, order] = found
        row |= compare_reference(renderer, list(camera_path(cloud, "pixel", STEPS, tilt, **SIZE)))
        rows.append(row)
    if capture is not None:
        row = {"scene": "captured", "splats": len(capture)}
        for order in ORDERS:
            row |= jump_of(order, largest_jump(renderer, around_capture(capture, order)))
        row |= compare_reference(renderer, list(around_capture(capture, "pixel")))
        rows.append(row)
    return rows


def with_marker(capture: fs.SplatCloud) -> tuple[fs.SplatCloud, fs.Camera]:
    """A captured scene with a marker next to it, behind a fisheye lens."""
    low, high = extent(capture)
    middle, height = (low + high) / 2, high[1] - low[1]
    camera = views(capture)["front"]
    rotation = camera.world_to_camera[:3, :3]
    tag = fs.marker("apriltag:36h11:5", size=0.2 * height).cloud
    beside = np.eye(4)
    beside[:3, :3] = rotation.T
    beside[:3, 3] = middle + rotation.T @ [0.35 * height, 0.0, -0.1 * height]
    lens = fs.Camera.fisheye(640, 480, math.radians(120), camera.world_to_camera)
    return fs.SplatCloud.concatenate([capture, tag.transformed(beside)]), lens


def timed_scenes(capture: fs.SplatCloud | None) -> dict[str, tuple[fs.SplatCloud, fs.Camera]]:
    """Cloud and camera of each row of the times."""
    scenes = {name: load_scene(name) for name in TIMED}
    before_wall = fs.SplatCloud.concatenate([fs.marker("apriltag:36h11:5", size=1.0).cloud, wall()])
    for name, cloud in (
        ("AprilTag before a wall", before_wall),
        (INTERSECTING, tilted_clouds()[INTERSECTING][0]),
    ):
        scenes[name] = cloud, next(camera_path(cloud, "auto", 0, 30.0, 1280, 720)).camera
    if capture is not None:
        scenes |= {"captured": (capture, views(capture)["front"]), WITH_MARKER: with_marker(capture)}
    return scenes


def times(
    renderer: fs.Renderer,
    scenes: dict[str, tuple[fs.SplatCloud, fs.Camera]],
    repeats: int,
    clock: Callable[[], float],
) -> list[dict]:
    """A row for each scene and cut-off."""
    rows = []
    for name, (cloud, camera) in track(scenes.items(), "times", console=PROGRESS):
        resident = renderer.upload(cloud)
        orders = TIMED_ORDERS if cloud.has_coplanar_groups else ORDERS
        for label, cutoff in CUTOFFS.items():
            timers = {
                order: frame_timer(
                    renderer,
                    resident,
                    fs.Capture(camera, quality=fs.Quality(alpha_cutoff=cutoff, order=order)),
                    clock=clock,
                )
                for order in orders
            }
            time_interleaved(list(timers.values()), repeats)
            row = {
                "scene": name,
                "cutoff": label,
                "ms": {order: timer.median for order, timer in timers.items()},
                "stages": {order: timer.part_medians for order, timer in timers.items()},
                "ratio": {order: quartiles(ratios(timers[order], timers["centre"])) for order in orders[1:]},
            }
            rows.append(row)
    return rows


def comparison(panels: dict) -> np.ndarray:
    """Images before and after the step and their difference, in both orders, (h, w, 3) uint8."""
    rows = []
    for order in ORDERS:
        jump, before, after = panels["QR 5", order]
        titled = (
            (f"order={order}", before),
            ("rotated by 0.0001 degrees", after),
            (f"difference, at most {jump:.2g}", np.abs(after - before)),
        )
        # centre of the code, enlarged three times
        crop = np.s_[48:144, 72:168]
        rows.append(
            [(title, to_uint8(image[crop]).repeat(3, axis=0).repeat(3, axis=1)) for title, image in titled]
        )
    return contact_sheet(rows, width=288)


def _number(value: float | int | None) -> str:
    return "-" if value is None else str(value) if isinstance(value, int) else f"{value:.1e}"


def main() -> None:
    parser = options(__doc__, repeats=15)
    parser.add_argument("--scene", metavar="FILE", help="a captured scene, y down, as in docs/experiments.md")
    parser.add_argument("-o", "--out", type=Path, help="PNG file for the comparison image")
    parser.add_argument("--rows", nargs="+", metavar="NAME", help="beginnings of the names of scenes to time")
    parser.add_argument("--cpu-time", action="store_true", help="measure processor time")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--times-only", action="store_true", help="skip the jumps and the image")
    part.add_argument("--jumps-only", action="store_true", help="skip the times")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    capture = None if arguments.scene is None else fs.load_ply(arguments.scene)
    panels: dict = {}
    figures = {**facts(renderer), "jumps": [] if arguments.times_only else jumps(renderer, capture, panels)}
    if arguments.out is not None and panels:
        write_png(arguments.out, comparison(panels))
    scenes = {} if arguments.jumps_only else timed_scenes(capture)
    if arguments.rows:
        scenes = {name: scene for name, scene in scenes.items() if name.startswith(tuple(arguments.rows))}
    clock = time.process_time if arguments.cpu_time else time.perf_counter
    figures["times"] = times(renderer, scenes, arguments.repeats, clock)
    if keep(figures, arguments.json):
        return
    title = f"Largest jump of a pixel on {renderer.device.title}"
    columns = [f"{what}_{order}" for what in ("step", "pixels", "shuffle") for order in ORDERS]
    columns[2:2] = ["step_reference", "beyond_reference"]
    cells = [
        (row["scene"], str(row["splats"]), *(_number(row.get(name)) for name in columns))
        for row in figures["jumps"]
    ]
    if cells:
        names = (f"{name.split('_')[0]}, {name.split('_')[1]}" for name in columns)
        show(title, ("scene", "splats", *names), cells)
    rows = []
    for row in figures["times"]:
        times_of = (f"{row['ms'][order]:.2f}" if order in row["ms"] else "-" for order in TIMED_ORDERS)
        ratios_of = (
            "{1:.2f} ({0:.2f} to {2:.2f})".format(*row["ratio"][order]) if order in row["ratio"] else "-"
            for order in TIMED_ORDERS[1:]
        )
        rows.append((row["scene"], row["cutoff"], *times_of, *ratios_of))
    if rows:
        heads = ("scene", "cut-off", *TIMED_ORDERS, *(f"{order} / centre" for order in TIMED_ORDERS[1:]))
        show("Milliseconds of a frame; ratio (quartiles)", heads, rows)


if __name__ == "__main__":
    main()
