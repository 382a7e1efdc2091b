"""Scene of hard cases: eight image cells, each sensitive to one constant."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.scenes.random_clouds import log_uniform
from fidsplat.selftest.clouds import rotation, splats
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_multiply

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
COLUMNS, ROWS = 4, 2
CELL = (WIDTH // COLUMNS, HEIGHT // ROWS)
"""width and height in pixels"""
PLACE = np.array([5e5, 4.5e6, 300.0])
"""position of the camera in metres, far from the origin as in map (UTM) coordinates"""


def hard_scene(seed: int = 0) -> tuple[SplatCloud, Camera]:
    """About 5000 splats on black in 640 x 480 pixels, 4.5 million metres from the origin; deterministic.

    haze: 300 layers of opacity 0.0039, below 1/255. veils: 300 of 0.05, whose rims a cut-off removes. opaque:
    40 stacks of layers of 0.98 to 1 in front of a lamp, which is visible through them with a ceiling of 0.99
    or without the last layer. edge-on: tilts of 89 to 89.9999 degrees. tiny: 0.01 to 0.5 px. pages: layers
    0.1 mm apart at 5 m, in random order. needles: 1000 to 30,000 times as long as wide. near: strips of
    ground that begin behind the camera.
    """
    generator = np.random.default_rng(seed)
    parts = [
        _layers(generator, 0, 300, 0.0039, 0.004, 25.0),
        _layers(generator, 1, 300, 0.05, 0.004, 22.0, wander=15.0),
        _opaque(generator, 2),
        _edge_on(generator, 3),
        _tiny(generator, 4),
        _layers(generator, 5, 40, 0.5, 1e-4, 30.0, wander=10.0, shuffled=True),
        _needles(generator, 6),
        _near(generator, 7),
    ]
    cloud = SplatCloud.concatenate(parts)
    cloud = SplatCloud(
        cloud.means, cloud.quats, cloud.scales, cloud.opacities, colors=cloud.colors, origin=PLACE
    )
    pose = np.eye(4)
    pose[:3, 3] = -PLACE
    camera = Camera.pinhole(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, world_to_camera=pose)
    return cloud, camera


def _at(number: int, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Points (n, 3) at depths (n,), at pixel offsets (n, 2) from the middle of a cell."""
    row, column = divmod(number, COLUMNS)
    middle = np.array([(column + 0.5) * CELL[0] - WIDTH / 2, (row + 0.5) * CELL[1] - HEIGHT / 2])
    return np.column_stack([(middle + pixels) / FOCAL * depth[:, None], depth])


def _layers(
    generator: np.random.Generator,
    cell: int,
    count: int,
    opacity: float,
    step: float,
    sigma_px: float,
    wander: float = 0.0,
    shuffled: bool = False,
) -> SplatCloud:
    """Layers of random colours at right angles to the view, a step apart, from 5 m on."""
    number = np.arange(count)
    if shuffled:
        generator.shuffle(number)
    depth = 5.0 + step * number
    means = _at(cell, generator.uniform(-wander, wander, (count, 2)), depth)
    scale = sigma_px / FOCAL * depth[:, None]
    return splats(means, (1, 0, 0, 0), scale, opacity, generator.uniform(0, 1, (count, 3)))


def _opaque(generator: np.random.Generator, cell: int) -> SplatCloud:
    stacks, high = 40, 3
    places = np.repeat(generator.uniform(-55, 55, (stacks, 2)) * (1.0, 1.5), high, axis=0)
    depth = 5.0 + np.tile(np.arange(high), stacks) * 0.3 + np.repeat(generator.uniform(0, 0.2, stacks), high)
    opacity = generator.uniform(0.98, 1.0, len(depth))
    colors = generator.uniform(0, 1, (len(depth), 3))
    layers = splats(_at(cell, places, depth), (1, 0, 0, 0), 5.0 / FOCAL * depth[:, None], opacity, colors)
    behind = np.array([8.0])
    lamp = splats(
        _at(cell, np.zeros((1, 2)), behind), (1, 0, 0, 0), 45 / FOCAL * behind, 1.0, (4.0, 4.0, 4.0)
    )
    return SplatCloud.concatenate([layers, lamp])


def _edge_on(generator: np.random.Generator, cell: int) -> SplatCloud:
    count = 200
    depth = generator.uniform(3, 8, count)
    means = _at(cell, generator.uniform(-60, 60, (count, 2)) * (1.0, 1.6), depth)
    # tilts relative to the ray of each splat, not to the axis of the camera
    quats = []
    for mean in means:
        ray = mean / np.linalg.norm(mean)
        across = np.cross(ray, generator.normal(size=3))
        normal = math.radians(90 - 10 ** generator.uniform(-4, 0))
        start = rotation(np.cross((0, 0, 1), ray), math.degrees(math.acos(ray[2])))
        quats.append(quaternion_multiply(rotation(across, math.degrees(normal)), start))
    return splats(
        means, np.array(quats), generator.uniform(0.02, 0.1, (count, 2)), 0.9,
        generator.uniform(0, 1, (count, 3)),
    )  # fmt: skip


def _tiny(generator: np.random.Generator, cell: int) -> SplatCloud:
    count = 4000
    depth = generator.uniform(3, 8, count)
    means = _at(cell, generator.uniform(-65, 65, (count, 2)) * (1.0, 1.6), depth)
    scale = log_uniform(generator, 0.01, 0.5, (count, 1)) / FOCAL * depth[:, None]
    quats = generator.normal(size=(count, 4))
    return splats(means, quats, scale * np.ones(2), 0.8, generator.uniform(0, 1, (count, 3)))


def _needles(generator: np.random.Generator, cell: int) -> SplatCloud:
    count = 150
    depth = generator.uniform(3, 8, count)
    means = _at(cell, generator.uniform(-40, 40, (count, 2)) * (1.0, 1.6), depth)
    long = generator.uniform(5, 15, count) / FOCAL * depth
    scales = np.column_stack([long, long / log_uniform(generator, 1e3, 3e4, count)])
    quats = generator.normal(size=(count, 4))
    return splats(means, quats, scales, 1.0, generator.uniform(0, 1, (count, 3)))


def _near(generator: np.random.Generator, cell: int) -> SplatCloud:
    """Strips on the ground, 0.5 m below the camera, that extend behind it."""
    count = 12
    across = np.linspace(0.42, 1.0, count)
    means = np.column_stack([across, np.full(count, 0.5), generator.uniform(0.5, 1.5, count)])
    lying = rotation((1, 0, 0), 90)
    scales = np.column_stack([np.full(count, 0.03), generator.uniform(0.8, 1.6, count)])
    return splats(means, lying, scales, 0.7, generator.uniform(0, 1, (count, 3)))
