"""Generate examples/data: a sky, a globe with view-dependent colours, and a corner of a room.

python examples/make_data.py [FOLDER]        default: examples/data
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.images.files import write_png
from fidsplat.splats.rotations import matrix_to_quaternion


def sky() -> np.ndarray:
    """Panorama with clouds from a few waves: (128, 256, 3), 0 to 1."""
    v, u = np.mgrid[0:128, 0:256] / [[[128]], [[256]]]
    waves = sum(np.sin(2 * np.pi * (k * u + 3 * v * k) + k * k) / k for k in (3, 5, 8, 13, 21)) / 2
    cloud = np.clip(1.5 * waves + 0.4, 0, 1)[..., None] * np.clip(2.4 - 4 * v, 0, 1)[..., None]
    blue = np.array([0.35, 0.55, 0.9]) * (1 - v[..., None]) + 0.75 * v[..., None]
    return (blue * (1 - cloud) + cloud).astype(np.float32)


def globe(degree: int = 3, n: int = 1500) -> fs.SplatCloud:
    """Sphere of radius 0.5 m around the origin, of n splats with spherical harmonics up to a degree."""
    z = 1 - (2 * np.arange(n) + 1) / n
    turn = np.pi * (1 + 5**0.5) * np.arange(n)
    normals = np.column_stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    # quaternion that rotates (0, 0, 1) to the normal
    quats = np.column_stack([1 + z, -normals[:, 1], normals[:, 0], np.zeros(n)])
    sh = np.zeros((n, (degree + 1) ** 2, 3), np.float32)
    shade = 0.5 + 0.35 * np.sin(7 * turn)[:, None] * [0.2, 0.6, 1.0]
    sh[:, 0] = (shade - 0.5) / 0.2820948
    shine = np.random.default_rng(0).normal(0, 0.5, sh.shape[1])
    # coefficients fall with the square of the degree, so that all degrees are visible
    weights = np.concatenate([np.full(2 * k + 1, 1 / max(k, 1) ** 1.5) for k in range(degree + 1)])
    sh[:, 1:] = (shine * weights)[1:, None]
    return fs.SplatCloud(0.5 * normals, quats, np.full((n, 2), 0.97 / np.sqrt(n)), np.full(n, 0.95), sh=sh)


def panel(middle, along, across, color, step: float = 0.08) -> fs.SplatCloud:
    """Rectangle of overlapping disks. along, across: half sides, perpendicular vectors in metres."""
    u, v = np.array(along, float), np.array(across, float)
    counts = [max(2, round(2 * np.linalg.norm(side) / step)) for side in (u, v)]
    fractions = [(np.arange(n) + 0.5) / n * 2 - 1 for n in counts]
    a, b = (grid.ravel() for grid in np.meshgrid(*fractions))
    axes = np.stack([u / np.linalg.norm(u), v / np.linalg.norm(v)])
    frame = np.column_stack([*axes, np.cross(*axes)])
    quat = np.tile(matrix_to_quaternion(frame), (len(a), 1))
    sizes = [0.6 * 2 * np.linalg.norm(side) / n for side, n in zip((u, v), counts, strict=True)]
    return fs.SplatCloud(
        np.array(middle) + np.outer(a, u) + np.outer(b, v),
        quat,
        np.tile(sizes, (len(a), 1)),
        np.full(len(a), 0.98),
        colors=np.tile(np.asarray(color, float), (len(a), 1)),
    )


def corner() -> fs.SplatCloud:
    """Corner of a room, 1.6 m wide: wall, shelf, floor, and a red side wall; y down, open towards -z."""
    return fs.SplatCloud.concatenate(
        [
            panel((0, 0, 0.5), (0.8, 0, 0), (0, 0.6, 0), (0.62, 0.6, 0.56)),
            panel((-0.8, 0, 0), (0, 0, 0.5), (0, 0.6, 0), (0.75, 0.2, 0.15)),
            panel((0, 0.6, 0), (0.8, 0, 0), (0, 0, 0.5), (0.45, 0.36, 0.28)),
            panel((0.2, -0.12, 0.36), (0.34, 0, 0), (0, 0, 0.13), (0.5, 0.35, 0.2), step=0.04),
        ]
    )


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent / "data"
    folder.mkdir(parents=True, exist_ok=True)
    print(write_png(folder / "sky.png", sky()))
    for name, cloud in (("globe", globe(n=400)), ("corner", corner())):
        fs.save_ply(cloud, folder / f"{name}.ply")
        print(folder / f"{name}.ply")


if __name__ == "__main__":
    main()
