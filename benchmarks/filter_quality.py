"""How well a QR code of version 22 shows with each low-pass and footprint: PSNR against the ideal picture.

    python benchmarks/filter_quality.py [--device opencl] [--picture FILE.png]

Frontal, over grey, a thousand characters at level L. Each pixel of the ideal picture is the exact mean of the
texture over its area. `--picture` writes a crop of each at 2 pixels per module, enlarged.
"""

from __future__ import annotations

import argparse
import math
import random
import string

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

import fidsplat as fs
from fidsplat.vision.images import to_uint8, write_png
from fidsplat.vision.paint import contact_sheet

SIZES = (1.0, 2.0, 4.571, 8.0)
"""pixels per module"""
GREY = 0.5
WAYS = {
    "fitted, screen": ("fitted", "screen", 1),
    "fitted, screen, 3 x 3": ("fitted", "screen", 3),
    "fitted, pixel": ("fitted", "pixel", 1),
    "fitted, pixel, 3 x 3": ("fitted", "pixel", 3),
    "fitted, none": ("fitted", "none", 1),
    "fitted, none, 3 x 3": ("fitted", "none", 3),
    "exact": ("exact", "none", 1),
}


def camera_of(made: fs.Marker, px: float) -> fs.Camera:
    """A camera 4 m away in which a module is `px` pixels, the code's middle between pixels."""
    side = int(made.grid.shape[0] * px) + 20
    pose = np.eye(4)
    pose[2, 3] = 4
    focal = 4 * px / made.module
    return fs.Camera.pinhole(side, side, focal, focal, side / 2 + 0.3, side / 2 - 0.2, pose)


def area_sampled(made: fs.Marker, px: float, camera: fs.Camera) -> np.ndarray:
    """The printed marker (h, w): every pixel the exact mean over its area."""

    def overlap(edges: np.ndarray, pixels: int) -> np.ndarray:
        left = np.arange(pixels)[:, None]
        return np.maximum(np.minimum(left + 1, edges[1:]) - np.maximum(left, edges[:-1]), 0)

    edges = (np.arange(made.grid.shape[0] + 1) - made.grid.shape[0] / 2) * px
    across, down = overlap(camera.cx + edges, camera.width), overlap(camera.cy + edges, camera.height)
    covered = down.sum(1)[:, None] * across.sum(1)
    return down @ (1.0 - made.grid) @ across.T + GREY * (1 - covered)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--picture", help="PNG file of crops")
    options = parser.parse_args()
    renderer = fs.Renderer(options.device)
    text = "".join(random.Random(0).choices(string.ascii_letters + string.digits, k=1000))
    markers = {mixture: fs.marker(f"qr-v22-L:{text}", mixture=mixture) for mixture in ("fitted", "exact")}
    table = Table("QR 22, PSNR in dB", *(f"{px:g} px" for px in SIZES), title=renderer.device.title)
    crops: list[tuple[str, np.ndarray]] = []
    for name, (mixture, lowpass, samples) in WAYS.items():
        made, row = markers[mixture], []
        for px in SIZES:
            camera = camera_of(made, px)
            quality = fs.Quality(alpha_cutoff=1 / 255, lowpass=lowpass, samples=samples)
            rgb = renderer.render(made.cloud, camera, quality=quality, background=(GREY,) * 3)["rgb"]
            error = rgb[..., 0] - area_sampled(made, px, camera)
            row.append(f"{-10 * math.log10(float((error * error).mean())):.1f}")
            if px == 2.0:
                crop = to_uint8(rgb[6:46, 6:46])
                crops.append((name, cv2.resize(crop, (240, 240), interpolation=cv2.INTER_NEAREST)))
        table.add_row(name, *row)
    Console(width=100).print(table)
    if options.picture:
        write_png(options.picture, contact_sheet([crops[:4], crops[4:]], width=240) // 16 * 16)


if __name__ == "__main__":
    main()
