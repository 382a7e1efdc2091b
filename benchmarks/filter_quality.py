"""Measure a QR code of version 22 with each low-pass and footprint: PSNR against the ideal image.

    python benchmarks/filter_quality.py [--device opencl] [--image FILE.png]

The code has a thousand characters at level L, and is rendered frontally over grey. Each pixel of the ideal
image is the exact mean of the texture over its area. `--image` writes enlarged crops at 2 pixels per module.
"""

from __future__ import annotations

import math
import random
import string

import cv2
import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.images.files import to_uint8, write_png
from fidsplat.images.visualize import contact_sheet

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
    """A camera 4 m away with modules of `px` pixels; the centre of the code is between pixels."""
    side = int(made.grid.shape[0] * px) + 20
    pose = np.eye(4)
    pose[2, 3] = 4
    focal = 4 * px / made.module
    return fs.Camera.pinhole(side, side, focal, focal, side / 2 + 0.3, side / 2 - 0.2, pose)


def area_sampled(made: fs.Marker, px: float, camera: fs.Camera) -> np.ndarray:
    """Ideal image of the printed marker (h, w), whose pixels are exact means over their areas."""

    def overlap(edges: np.ndarray, pixels: int) -> np.ndarray:
        left = np.arange(pixels)[:, None]
        return np.maximum(np.minimum(left + 1, edges[1:]) - np.maximum(left, edges[:-1]), 0)

    edges = (np.arange(made.grid.shape[0] + 1) - made.grid.shape[0] / 2) * px
    across, down = overlap(camera.cx + edges, camera.width), overlap(camera.cy + edges, camera.height)
    covered = down.sum(1)[:, None] * across.sum(1)
    return down @ (1.0 - made.grid) @ across.T + GREY * (1 - covered)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--image", help="PNG file of crops")
    arguments = parser.parse_args()
    renderer = fs.Renderer(arguments.device)
    text = "".join(random.Random(0).choices(string.ascii_letters + string.digits, k=1000))
    markers = {mixture: fs.marker(f"qr-v22-L:{text}", mixture=mixture) for mixture in ("fitted", "exact")}
    rows: list[dict] = []
    crops: list[tuple[str, np.ndarray]] = []
    for name, (mixture, lowpass, samples) in WAYS.items():
        made, row = markers[mixture], {}
        for px in SIZES:
            camera = camera_of(made, px)
            quality = fs.Quality(alpha_cutoff=1 / 255, lowpass=lowpass, samples=samples)
            rgb = renderer.render(made.cloud, camera, quality=quality, background=(GREY,) * 3)["rgb"]
            error = rgb[..., 0] - area_sampled(made, px, camera)
            row[f"{px:g} px"] = -10 * math.log10(float((error * error).mean()))
            if px == 2.0:
                crop = to_uint8(rgb[6:46, 6:46])
                crops.append((name, cv2.resize(crop, (240, 240), interpolation=cv2.INTER_NEAREST)))
        rows.append({"way": name, "psnr_db": row})
    if arguments.image:
        write_png(arguments.image, contact_sheet([crops[:4], crops[4:]], width=240) // 16 * 16)
    if keep({**facts(renderer), "rows": rows}, arguments.json):
        return
    heads = ("QR 22, PSNR in dB", *rows[0]["psnr_db"])
    cells = ((row["way"], *(f"{value:.1f}" for value in row["psnr_db"].values())) for row in rows)
    show(renderer.device.title, heads, cells)


if __name__ == "__main__":
    main()
