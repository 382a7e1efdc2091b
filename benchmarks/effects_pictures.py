"""Makes the pictures of docs/effects.md that show footprints, outputs, sensor, fog and backgrounds.

python benchmarks/effects_pictures.py [--device opencl] [--out docs/images]
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.vision.images import to_uint8, write_png
from fidsplat.vision.paint import contact_sheet, count_picture, depth_picture, label_picture, normal_picture

WIDTH, HEIGHT = 320, 200
PAINT = {"depth": depth_picture, "distance": depth_picture, "normal": normal_picture}
PAINT |= {"label": label_picture, "splat_id": label_picture, "blended": count_picture}


def room(mixture: str) -> fs.Scene:
    """Three tags on a path of grey splats."""
    generator = np.random.default_rng(2)
    n = 4000
    means = np.column_stack([generator.uniform(-4, 4, n), np.full(n, 0.6), generator.uniform(0.5, 14, n)])
    means[:, 1] += generator.normal(0, 0.02, n)
    lying = [math.cos(math.pi / 4), math.sin(math.pi / 4), 0, 0]
    shade = generator.uniform(0.2, 0.5, (n, 1)) * [1.0, 0.9, 0.7]
    ground = fs.SplatCloud(
        means, np.tile(lying, (n, 1)), np.full((n, 2), 0.12), np.full(n, 0.9), colors=shade
    )
    tags = []
    for number, (x, z, turn) in enumerate(((-0.6, 2.2, 25), (0.7, 4.0, -35), (-0.2, 8.0, 10))):
        a = math.radians(turn)
        pose = np.eye(4)
        pose[0, [0, 2]], pose[2, [0, 2]] = (math.cos(a), math.sin(a)), (-math.sin(a), math.cos(a))
        pose[:3, 3] = (x, 0, z)
        tags.append(PlacedMarker(fs.marker(f"apriltag:36h11:{number}", size=0.9, mixture=mixture), pose))
    camera = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(62), (0.1, -0.5, -0.4), (0, 0.1, 5))
    return fs.Scene([ground], camera, tags, background=(0.55, 0.7, 0.9))


def sky() -> fs.Panorama:
    """A panorama with clouds, made of a few waves."""
    v, u = np.mgrid[0:256, 0:512] / [[[256]], [[512]]]
    waves = sum(np.sin(2 * np.pi * (k * u + 3 * v * k) + k * k) / k for k in (3, 5, 8, 13, 21)) / 2
    cloud = np.clip(waves + 0.3, 0, 1)[..., None] * np.clip(1.6 - 3 * v, 0, 1)[..., None]
    blue = np.array([0.35, 0.55, 0.9]) * (1 - v[..., None]) + 0.75 * v[..., None]
    return fs.Panorama(blue * (1 - cloud) + cloud)


def small(rows: list[list[tuple[str, np.ndarray]]], width: int) -> np.ndarray:
    """A sheet with 5 bits per channel: pages should load fast."""
    return contact_sheet(rows, width=width) // 8 * 8


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--device", default="opencl")
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).resolve().parent.parent / "docs" / "images"
    )
    options = parser.parse_args()
    renderer = fs.Renderer(options.device)
    scene, exact = room("fitted"), room("exact")

    def picture(what: fs.Scene, **call) -> np.ndarray:
        return to_uint8(renderer.render(what, **call)["rgb"])

    near = fs.Camera.look_at(WIDTH, HEIGHT, math.radians(14), (0.1, -0.5, -0.4), (-0.55, 0.0, 2.2))
    far = replace(
        near, world_to_camera=fs.Camera.look_at(8, 8, 1, (0.1, -0.5, -0.4), (-0.2, 0, 8)).world_to_camera
    )
    boxes = [
        [("fitted, near", picture(scene, camera=near)), ("exact, near", picture(exact, camera=near))],
        [("fitted, far", picture(scene, camera=far)), ("exact, far", picture(exact, camera=far))],
    ]
    write_png(options.out / "effect-boxes.png", small(boxes, 170))

    frame = renderer.render(exact, outputs=("rgb", *PAINT))
    planes = [(name, paint(frame[name])) for name, paint in PAINT.items()]
    write_png(options.out / "effect-outputs.png", small([planes[:3], planes[3:]], 150))

    seen = [
        ("plain", picture(exact)),
        ("fog 0.15 / m", picture(exact, fog=fs.Fog(0.15, (0.75, 0.78, 0.8)))),
        ("gradient", picture(exact, background=fs.Gradient((0.1, 0.25, 0.7), (1.0, 0.95, 0.85)))),
        ("panorama", picture(exact, background=sky())),
        ("vignetting -0.6", picture(exact, sensor=fs.Sensor(vignetting=(-0.6,)))),
        ("noise, 200 electrons", picture(exact, sensor=fs.Sensor(full_well=200, read_noise=6))),
    ]
    write_png(options.out / "effect-sensor.png", small([seen[:3], seen[3:]], 140))


if __name__ == "__main__":
    main()
