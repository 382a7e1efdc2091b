"""Measure markers of each mixture: splats, seconds and PSNR.

    python benchmarks/marker_quality.py [--device opencl] [--mixtures NAME ...] [--edge-px 480] [--repeats 7]
        [--json]

AprilTag 36h11 id 0, and QR codes in byte mode at level L of seeded random strings of 20, 100, 250 and 1000
characters (versions 2, 5, 10 and 22), rendered frontally at 800 x 800, the code's edge `--edge-px` pixels
long, low-pass off, 3 x 3 samples per pixel, over grey. PSNR is taken against the ideal texture (each pixel
the mean of 12 x 12 points) within the quiet zone's outer edge and one module around it. "layer" is fidsplat's
order of a marker (Quality.order "auto"); "centre" composites by the depth of the splats' centres, here all
equal, so by index, as other renderers do with the exported file; "tilted 30" is "centre" again from 30
degrees, where the centres' depths decide. Seconds are the median time from the spec to the cloud in a warm
process, on one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
import string
import sys
from datetime import date

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.capture.quality import TEMPLATE_SIZES
from fidsplat.markers import Marker, marker

IMAGE_SIZE = 800
FINE = 12
LENGTHS = {"QR 2": 20, "QR 5": 100, "QR 10": 250, "QR 22": 1000}
MIXTURES = {
    "paper": {"mixture": "paper", "levels": 4, "density": 3},
    "paper, grown": {"mixture": "paper", "levels": 4, "density": 3, "growth": 0.4},
    "fitted": {"mixture": "fitted"},
    **{f"fitted, {size}": {"mixture": "fitted", "template": size} for size in TEMPLATE_SIZES if size != 25},
}
VIEWS = {"layer": ("auto", 0.0), "centre": ("centre", 0.0), "tilted 30": ("centre", 30.0)}


def categories(seed: int) -> dict[str, str]:
    """Specs of the paper's five categories of markers, by name."""
    specs = {"AprilTag": "apriltag:36h11:0"}
    for name, length in LENGTHS.items():
        text = "".join(random.Random(seed).choices(string.ascii_letters + string.digits, k=length))
        specs[name] = f"qr-v{name[3:]}-L:{text}"
    return specs


def camera_at(made: Marker, edge_px: float, tilt: float) -> fs.Camera:
    """A camera at a distance of 4 code edges from a marker that is tilted back by `tilt` degrees; without
    tilt the edge has `edge_px` pixels."""
    distance = 4.0 * made.size
    focal = edge_px * 4.0
    a = math.radians(tilt)
    placed = np.eye(4)
    placed[1:3, 1:3] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    placed[2, 3] = distance
    return fs.Camera.pinhole(IMAGE_SIZE, IMAGE_SIZE, focal, focal, IMAGE_SIZE / 2, IMAGE_SIZE / 2, placed)


def ideal_image(made: Marker, camera: fs.Camera, background: float) -> tuple[np.ndarray, np.ndarray]:
    """Ideal image of the printed marker, (h, w) in [0, 1], and the mask of the compared pixels."""
    at = (np.arange(IMAGE_SIZE * FINE) + 0.5) / FINE
    to_plane = np.linalg.inv(camera.matrix @ camera.world_to_camera[:3, [0, 1, 3]])
    image = np.empty((IMAGE_SIZE, IMAGE_SIZE))
    counts = np.empty((IMAGE_SIZE, IMAGE_SIZE), bool)
    h, w = made.grid.shape
    for row in range(IMAGE_SIZE):  # a row of pixels at a time: all points at once would take gigabytes
        x, y = np.meshgrid(at, at[row * FINE : (row + 1) * FINE])
        u, v, scale = np.einsum("ij,jyx->iyx", to_plane, np.stack([x, y, np.ones_like(x)]))
        column = np.floor(u / scale / made.module + w / 2).astype(int)
        line = np.floor(v / scale / made.module + h / 2).astype(int)
        inside = (column >= 0) & (column < w) & (line >= 0) & (line < h)
        value = np.full(x.shape, background)
        value[inside] = 1.0 - made.grid[line[inside], column[inside]]
        image[row] = value.reshape(FINE, IMAGE_SIZE, FINE).mean((0, 2))
        near = (column >= -1) & (column <= w) & (line >= -1) & (line <= h)
        counts[row] = near.reshape(FINE, IMAGE_SIZE, FINE).all((0, 2))
    return image, counts


def measure(renderer: fs.Renderer, made: Marker, edge_px: float, background: float, ideals: dict) -> dict:
    """PSNR in dB for each of VIEWS."""
    found = {}
    for name, (order, tilt) in VIEWS.items():
        camera = camera_at(made, edge_px, tilt)
        if (made.spec, tilt) not in ideals:
            ideals[made.spec, tilt] = ideal_image(made, camera, background)
        ideal, counts = ideals[made.spec, tilt]
        quality = fs.Quality(alpha_cutoff=1 / 255, lowpass="none", samples=3, order=order)
        frame = renderer.render(made.cloud, camera, quality=quality, background=(background,) * 3)
        off = frame["rgb"].mean(2)[counts] - ideal[counts]
        found[name] = float(-10 * np.log10(np.mean(off * off)))
    return found


def run(options: argparse.Namespace) -> list[dict]:
    """One row for each category and mixture."""
    renderer = fs.Renderer(options.device)
    ideals: dict = {}
    rows = []
    work = [
        (c, s, m, k)
        for c, s in categories(options.seed).items()
        for m, k in MIXTURES.items()
        if m in options.mixtures
    ]
    for category, spec, mixture, kwargs in track(work, "markers", console=Console(stderr=True)):
        made = marker(spec, **kwargs)
        seconds = [marker(spec, **kwargs).seconds for _ in range(options.repeats)]
        dark = sum(rectangle.dark for rectangle in made.rectangles)
        rows.append(
            {
                "category": category,
                "mixture": mixture,
                "modules": made.bits.shape[0],
                "components": made.components,
                "rectangles": {"dark": dark, "light": len(made.rectangles) - dark},
                "splats": len(made.cloud),
                "seconds": statistics.median(seconds),
                "psnr_db": measure(renderer, made, options.edge_px, options.background, ideals),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--mixtures", nargs="+", choices=MIXTURES, default=list(MIXTURES))
    parser.add_argument(
        "--edge-px", type=float, default=480.0, help="edge of the code in pixels (430 or more)"
    )
    parser.add_argument("--background", type=float, default=0.5, help="grey behind the marker")
    parser.add_argument("--repeats", type=int, default=7, help="constructions timed")
    parser.add_argument("--seed", type=int, default=0, help="of the QR codes' strings")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = run(options)
    if options.json:
        json.dump({"date": date.today().isoformat(), **vars(options), "rows": rows}, sys.stdout, indent=2)
        print()
        return
    table = Table(title=f"Markers, code {options.edge_px:g} px wide, PSNR in dB", title_justify="left")
    heads = ("marker", "mixture", "dark + light", "splats", "each", "seconds", *VIEWS)
    for i, head in enumerate(heads):
        table.add_column(head, justify="left" if i < 2 else "right")
    for row in rows:
        dark, light = row["rectangles"].values()
        table.add_row(
            row["category"],
            row["mixture"],
            f"{dark} + {light}",
            str(row["splats"]),
            f"{row['splats'] / (dark + light):.1f}",
            f"{row['seconds']:.4f}",
            *(f"{value:.2f}" for value in row["psnr_db"].values()),
            end_section=row["mixture"] == options.mixtures[-1],
        )
    Console().print(table)


if __name__ == "__main__":
    main()
