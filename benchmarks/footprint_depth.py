"""How deep a sample's footprint may be under `lowpass="pixel"`: pictures of what is seen nearly edge-on.

    python benchmarks/footprint_depth.py [--focal 300 1000 3000] [--splats 600] [--json FILE]

Walls of small splats, and single ones of 4 mm to half a metre, 0.05 to 1.6 degrees from their edge, drawn by
the reference with footprints of several shares of the depth (endless: as EWA has it; the kernels' share is
`DEPTH_SHARE`), beside the truth: without a low-pass, 16 x 16 samples a pixel weighed by a Gaussian of half a
pixel. Of each focal length [pixels] the square root of the sum over pixels of squared differences of alpha,
in the mean (root of the mean square) over angles and over these five.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from measuring import facts, keep, options, show

import fidsplat as fs
from fidsplat.accuracy import TRUTH_CUTOFF
from fidsplat.backends.reference import setup

SIZE = 96, 64
SHARES = (math.inf, 1 / 4, 1 / 6, 1 / 8, 1 / 10, 1 / 12, 1 / 16, 1 / 32)
ANGLES = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
FINE = 8
"""pixels of the truth's picture to one of the others', along a side, of 2 x 2 samples each"""


def subjects(angle: float, splats: int, seed: int) -> Iterator[fs.SplatCloud]:
    """On planes x = constant, seen at this angle [rad]; of each kind nearest, furthest, size, opacity."""
    kinds = (
        (2, 8, 0.02, 0.05),
        (50, 200, 0.02, 0.5),
        (4, 4, 0.004, 0.9),
        (4, 4, 0.05, 0.9),
        (4, 4, 0.5, 0.5),
    )
    generator = np.random.default_rng(seed)
    for nearest, furthest, size, opacity in kinds:
        count = splats if furthest > nearest else 1
        depth = generator.uniform(nearest, furthest, count)
        beside = np.full(count, math.tan(angle) * math.sqrt(nearest * furthest))
        means = np.column_stack([beside, generator.uniform(-0.02, 0.02, count) * depth, depth])
        quats = np.tile((math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0), (count, 1))
        sizes, opacities = np.full((count, 2), size), np.full(count, opacity)
        yield fs.SplatCloud(means, quats, sizes, opacities, colors=np.ones((count, 3)))


def camera(focal: float, center: float, scale: int = 1) -> fs.Camera:
    width, height = (side * scale for side in SIZE)
    focal *= scale
    return fs.Camera.pinhole(width, height, focal, focal, center * scale, height / 2)


def weights(pixels: int) -> np.ndarray:
    """(pixels, FINE * pixels): a Gaussian of half a pixel around each one's middle."""
    fine, middles = (np.arange(FINE * pixels) + 0.5) / FINE, np.arange(pixels) + 0.5
    away = (fine[None, :] - middles[:, None]) / 0.5
    return np.exp(-0.5 * away**2) / (FINE * 0.5 * math.sqrt(2 * math.pi))


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--focal", type=float, nargs="+", default=[300.0, 1000.0, 3000.0])
    parser.add_argument("--splats", type=int, default=600, help="of a wall")
    asked = parser.parse_args()
    device, reference, rows = fs.Renderer(asked.device), fs.Renderer("reference"), []
    exact = fs.Quality(lowpass="none", alpha_cutoff=TRUTH_CUTOFF, samples=2)
    widened = fs.Quality(lowpass="pixel", alpha_cutoff=TRUTH_CUTOFF)
    shifts = np.random.default_rng(1).uniform(-0.5, 0.5, len(ANGLES))
    for focal in asked.focal:
        squares: dict[float, list[float]] = {share: [] for share in SHARES}
        for number, (degrees, shift) in enumerate(zip(ANGLES, shifts, strict=True)):
            angle = math.radians(degrees)
            center = SIZE[0] / 2 - focal * math.tan(angle) + shift
            for cloud in subjects(angle, asked.splats, number):
                fine = device.render(cloud, camera(focal, center, FINE), ("alpha",), exact)["alpha"]
                truth = weights(SIZE[1]) @ fine.astype(np.float64) @ weights(SIZE[0]).T
                for share in SHARES:
                    setup.DEPTH_SHARE = share
                    frame = reference.render(cloud, camera(focal, center), ("alpha",), widened)
                    squares[share].append(float(((frame["alpha"] - truth) ** 2).sum()))
        rows.append({"focal": focal, "off": {f"{s:.4f}": math.sqrt(np.mean(squares[s])) for s in SHARES}})
        keep({**facts(device), "rows": rows}, asked.json)
    names = ("endless" if math.isinf(share) else f"1/{1 / share:.0f}" for share in SHARES)
    show(
        "difference of alpha by the depth of footprints",
        ("focal length", *names),
        ((f"{row['focal']:.0f}", *(f"{off:.3f}" for off in row["off"].values())) for row in rows),
    )


if __name__ == "__main__":
    main()
