"""What the order of splats does to a picture, and what it costs (docs/order.md).

    python benchmarks/order.py [--device opencl] [--scene FILE] [--repeats 15]
        [-o docs/images/order-jump.png] [--json FILE] [--times-only | --jumps-only]

Jumps: how far a pixel goes when a camera turns in steps of 1e-4 degrees, by the depth of centres and by
depth at each pixel, and when the splats are shuffled. Markers of Gaussians alone and 5 cm before a wall of
2000 splats of no plane, 1000 splats that cross, and the captured scene of --scene; 20 steps about the view
in which the centres of a marker face to face change places; 240 x 192 pixels. The picture shows a QR code
face to face before and after the worst step. For `pixel`, the 16 pixels that jump furthest are drawn by the
float64 reference too, along the same path: how far they jump there, and how far ours jump beyond that, in a
step or in those beside it, as rounding may let an edge pass a pixel one step sooner.

Times: frames of the standard scenes, of a default marker before the wall and of the splats that cross (30
degrees, 1280 x 720), and of --scene in both orders, in turns, splats resident, with the standard cut-off and
with 1/255; the median of the ratios, and its quartiles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
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
from fidsplat.util.timing import frame_timer, quartiles, ratios, take_turns

ORDERS = ("centre", "pixel")
SIZE = {"width": 240, "height": 192}
STEPS = 10
LOOKED_AT = 16
"""pixels of a scene that the reference draws"""
CUTOFFS = {"standard": 1e-5, "1/255": 1 / 255}
TIMED = ("r100k_720p", "r1m_1080p")
CROSSING = "1000 splats that cross"


def marker(spec: str) -> fs.SplatCloud:
    """A marker of Gaussians, 1 m wide."""
    return fs.marker(spec, size=1.0, mixture="fitted").cloud


def turned_about() -> dict[str, tuple[fs.SplatCloud, float]]:
    """Clouds about the origin, and by how many degrees they are tilted."""
    tag, crossing = marker("apriltag:36h11:5"), random_splats(1000, 3, (-0.5, 0.5), (0.05, 0.4), across=1.0)
    before_wall = fs.SplatCloud.concatenate([tag, wall()])
    return {
        "AprilTag 36h11": (tag, 0.0),
        "QR 5": (marker("qr-v5-L:fidsplat"), 0.0),
        **{f"AprilTag before a wall, {tilt:g} deg": (before_wall, tilt) for tilt in (0.0, 30.0, 60.0)},
        CROSSING: (crossing, 30.0),
    }


def around_capture(cloud: fs.SplatCloud, order: str) -> Iterator[FrameSpec]:
    """A captured scene from the front, the camera going round it."""
    low, high = extent(cloud)
    middle, front = (low + high) / 2, views(cloud)["front"].position
    for number in range(-STEPS, STEPS + 1):
        turn = number * STEP
        away = front - middle
        c, s = math.cos(turn), math.sin(turn)
        position = middle + np.array([c * away[0] + s * away[2], away[1], c * away[2] - s * away[0]])
        camera = fs.Camera.look_at(SIZE["width"], SIZE["height"], math.radians(60), position, middle)
        yield FrameSpec(cloud, camera, fs.Quality(order=order), ("rgb",))


def beside_reference(renderer: fs.Renderer, pictures: list[FrameSpec]) -> dict:
    """The largest jump of the reference at the pixels that jump furthest, and of ours beyond it."""
    drawn = np.stack([render(renderer, picture)["rgb"] for picture in pictures])
    furthest = np.abs(np.diff(drawn, axis=0)).max((0, 3))
    at = np.unravel_index(np.argsort(-furthest, axis=None)[:LOOKED_AT], furthest.shape)
    truth = np.stack([reference_images(picture, at)["rgb"] for picture in pictures])
    ours, wanted = (np.abs(np.diff(rgb, axis=0)).max(2) for rgb in (drawn[:, *at], truth))
    padded = np.pad(wanted, ((1, 1), (0, 0)))
    allowed = np.max([padded[:-2], wanted, padded[2:]], axis=0)
    return {"step_reference": float(wanted.max()), "beyond_reference": float((ours - allowed).max())}


def jump_of(order: str, found: tuple[float, np.ndarray, np.ndarray]) -> dict:
    """The largest change of a pixel in the worst step, and how many change by more than 1/255 there."""
    jump, before, after = found
    return {f"step_{order}": jump, f"pixels_{order}": int((np.abs(after - before).max(2) > 1 / 255).sum())}


def jumps(renderer: fs.Renderer, capture: fs.SplatCloud | None, panels: dict) -> list[dict]:
    """A row for each scene; what the QR code looks like goes to `panels`."""
    rows = []
    for name, (cloud, tilt) in track(turned_about().items(), "jumps", console=PROGRESS):
        shuffled = subset_of(cloud, np.random.default_rng(0).permutation(len(cloud)))
        row = {"scene": name, "splats": len(cloud)}
        for order in ORDERS:
            found = largest_jump(renderer, camera_path(cloud, order, STEPS, tilt, **SIZE))
            first, again = (next(camera_path(one, order, 0, tilt, **SIZE)) for one in (cloud, shuffled))
            change = np.abs(render(renderer, first)["rgb"] - render(renderer, again)["rgb"]).max()
            row |= jump_of(order, found) | {f"shuffle_{order}": float(change)}
            panels[name, order] = found
        row |= beside_reference(renderer, list(camera_path(cloud, "pixel", STEPS, tilt, **SIZE)))
        rows.append(row)
    if capture is not None:
        row = {"scene": "captured", "splats": len(capture)}
        for order in ORDERS:
            row |= jump_of(order, largest_jump(renderer, around_capture(capture, order)))
        row |= beside_reference(renderer, list(around_capture(capture, "pixel")))
        rows.append(row)
    return rows


def times(renderer: fs.Renderer, capture: fs.SplatCloud | None, repeats: int) -> list[dict]:
    """A row for each scene and cut-off."""
    scenes = {name: load_scene(name) for name in TIMED}
    before_wall = fs.SplatCloud.concatenate([fs.marker("apriltag:36h11:5", size=1.0).cloud, wall()])
    for name, cloud in (("AprilTag before a wall", before_wall), (CROSSING, turned_about()[CROSSING][0])):
        scenes[name] = cloud, next(camera_path(cloud, "auto", 0, 30.0, 1280, 720)).camera
    if capture is not None:
        scenes["captured"] = capture, views(capture)["front"]
    rows = []
    for name, (cloud, camera) in track(scenes.items(), "times", console=PROGRESS):
        resident = renderer.upload(cloud)
        for words, cutoff in CUTOFFS.items():
            centre, pixel = timers = [
                frame_timer(
                    renderer,
                    resident,
                    fs.Capture(camera, quality=fs.Quality(alpha_cutoff=cutoff, order=order)),
                )
                for order in ORDERS
            ]
            take_turns(timers, repeats)
            low, middle, high = quartiles(ratios(pixel, centre))
            ms = dict(zip(ORDERS, (centre.median, pixel.median), strict=True))
            rows.append({"scene": name, "cutoff": words, "ms": ms, "ratio": middle, "quartiles": [low, high]})
    return rows


def picture(panels: dict) -> np.ndarray:
    """Before, after and the difference in both orders, (h, w, 3) uint8."""
    rows = []
    for order in ORDERS:
        jump, before, after = panels["QR 5", order]
        titled = (
            (f"order={order}", before),
            ("turned by 0.0001 degrees", after),
            (f"difference, at most {jump:.2g}", np.abs(after - before)),
        )
        # the code's middle, each pixel three wide
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
    parser.add_argument("-o", "--out", type=Path, help="PNG file for the picture")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--times-only", action="store_true", help="no jumps, and so no picture")
    part.add_argument("--jumps-only", action="store_true", help="no times")
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    capture = None if asked.scene is None else fs.load_ply(asked.scene)
    panels: dict = {}
    figures = {**facts(renderer), "jumps": [] if asked.times_only else jumps(renderer, capture, panels)}
    if asked.out is not None and panels:
        write_png(asked.out, picture(panels))
    figures["times"] = [] if asked.jumps_only else times(renderer, capture, asked.repeats)
    if keep(figures, asked.json):
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
        low, high = row["quartiles"]
        times_of = (f"{row['ms'][order]:.1f}" for order in ORDERS)
        rows.append(
            (row["scene"], row["cutoff"], *times_of, f"{row['ratio']:.2f}", f"{low:.2f} to {high:.2f}")
        )
    if rows:
        show("Milliseconds of a frame", ("scene", "cut-off", *ORDERS, "ratio", "quartiles"), rows)


if __name__ == "__main__":
    main()
