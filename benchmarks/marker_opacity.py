"""Whether a marker is opaque and clean: an AprilTag seen frontally over grey, its modules along the pixels.

    python benchmarks/marker_opacity.py [--device opencl] [--spec apriltag:36h11:0] [--distance 100]
        [--mixtures fitted refined facets exact]

For each way of making it, pixels a module and quality: PSNR over the sheet from the ideal picture in dB; the
least alpha inside the outline less 2 % of a module; the largest error inside cells, an eighth of a module and
a pixel from their edges. `refined` is optimised on the device first, half a minute each. The distance, in
modules, matters to `facets` alone, which lie at depths of their own.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import fidsplat as fs
from fidsplat.markers import Marker, marker
from fidsplat.quality import BY_FORMULA, LADDER, MarkerQuality
from fidsplat.train import refine
from fidsplat.train.refining import LEAK

SHOWN = ("fitted", "refined", "facets", "exact")
TEMPLATES = (MarkerQuality.template, *BY_FORMULA)
REFINED = ((MarkerQuality.template, 0.001), (MarkerQuality.template, LEAK), (LADDER, LEAK))
"""Templates that are refined, and what leaks cost."""
QUALITIES = {
    "no low-pass, 3 x 3": fs.Quality(lowpass="none", samples=3),
    "the same by centres": fs.Quality(lowpass="none", samples=3, order="centre"),
    "standard": fs.Quality(),
    "gsplat, surfel": fs.Quality.of("gsplat"),
}
BORDER = 20
"""pixels around the sheet"""


def figures(
    renderer: fs.Renderer, tag: Marker, pixels: int, quality: fs.Quality, away: float
) -> tuple[float, float, float]:
    """PSNR, least alpha, largest error inside cells; from `away` modules."""
    side, focal = len(tag.grid) * pixels + 2 * BORDER, away * pixels
    pose = fs.Camera.look_at(side, side, 1.0, (0, 0, -away * tag.module), (0, 0, 0)).world_to_camera
    camera = fs.Camera.pinhole(side, side, focal, focal, side / 2, side / 2, pose)
    frame = renderer.render(tag.cloud, camera, ("rgb", "alpha"), quality, background=(0.5, 0.5, 0.5))
    shown, alpha = (frame[name][BORDER:-BORDER, BORDER:-BORDER] for name in ("rgb", "alpha"))
    error = shown.mean(2) - np.kron(1.0 - tag.grid, np.ones((pixels, pixels)))
    edge, rim = max(1, math.ceil(0.02 * pixels)), pixels // 8 + 1
    cells = error.reshape(len(tag.grid), pixels, len(tag.grid), pixels)[:, rim:-rim, :, rim:-rim]
    psnr = -10 * math.log10(float((error**2).mean()))
    return psnr, float(alpha[edge:-edge, edge:-edge].min()), float(np.abs(cells).max())


def markers(renderer: fs.Renderer, spec: str, mixtures: list[str]) -> Iterator[tuple[str, Marker]]:
    """What is shown, by its name."""
    made = {size: marker(spec, mixture="fitted", template=size) for size in TEMPLATES}
    if "fitted" in mixtures:
        for size, each in made.items():
            yield f"fitted {size}", each
    if "refined" in mixtures:
        for size, leak in REFINED:
            yield f"refined {size}, leak {leak:g}", refine(made[size], renderer, leak=leak)
    for name in ("facets", "exact"):
        if name in mixtures:
            yield name, marker(spec, mixture=name)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument("--spec", default="apriltag:36h11:0", help="the marker (default: apriltag:36h11:0)")
    parser.add_argument("--distance", type=float, default=100.0, metavar="MODULES", help="(default: 100)")
    parser.add_argument("--mixtures", nargs="+", choices=SHOWN, default=list(SHOWN), help="(default: all)")
    asked = parser.parse_args()
    renderer = fs.Renderer(asked.device)
    table = Table(
        "marker", "splats", "px a module", "quality", "PSNR", "alpha", "error", title=renderer.device.title
    )
    made = list(markers(renderer, asked.spec, asked.mixtures))
    for name, tag in track(made, "pictures", console=Console(stderr=True)):
        for pixels in (8, 24):
            for words, quality in QUALITIES.items():
                psnr, alpha, error = figures(renderer, tag, pixels, quality, asked.distance)
                table.add_row(
                    name,
                    str(len(tag.cloud)),
                    str(pixels),
                    words,
                    f"{psnr:.1f}",
                    f"{alpha:.3f}",
                    f"{error:.3f}",
                )
    Console().print(table)


if __name__ == "__main__":
    main()
