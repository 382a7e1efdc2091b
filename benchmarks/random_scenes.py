"""Small and diverse random scenes, identical on every machine for a seed: for measuring the candidates of
`quality_within` (candidates.py) and, with other seeds, checking its promises (quality_within_promise.py).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.scenes.random_clouds import log_uniform
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_to_matrix

MOST_SPLATS = 1500
MOST_HAZE = 600
HELD_OUT = 1_000_000
"""First seed of the held-out scenes."""


@dataclass(frozen=True)
class RandomScene:
    """Splats, camera and background of a random scene."""

    cloud: SplatCloud
    camera: Camera
    background: tuple[float, float, float]


def random_scene(seed: int, crossing: bool = False) -> RandomScene:
    """The scene of a seed: 1 to 2100 splats, 16 to 96 pixels wide and 12 to 72 high.

    Splats from far below a pixel to larger than the image, of one size or of many, isotropic or elongated;
    opaque, of any opacity, or so faint that hundreds of them make a haze; some in a coplanar group, some
    across the near plane; cameras from wide to narrow, near and far; any background.

    Every fifth scene is a single coplanar group, like a marker. `crossing`: in every scene half of the splats
    are in a coplanar group that the others intersect.
    """
    generator = np.random.default_rng([seed, 7])
    width, height = int(generator.integers(16, 97)), int(generator.integers(12, 73))
    focal = max(width, height) * float(log_uniform(generator, 0.5, 3.0))
    middle = float(log_uniform(generator, 0.5, 50.0))  # metres to the centre of the splats
    parts = [_splats(generator, _count(generator, MOST_SPLATS), focal, (width, height), middle, faint=False)]
    printed = crossing or generator.random() < 0.2
    if not printed and generator.random() < 0.5:
        parts.append(
            _splats(generator, _count(generator, MOST_HAZE), focal, (width, height), middle, faint=True)
        )
    means, quats, scales, opacities = (np.concatenate([part[k] for part in parts]) for k in range(4))
    count = len(means)
    planes = np.full(count, -1)
    if printed:
        own = np.flatnonzero(generator.random(count) < 0.5) if crossing else np.arange(count)
        quats[own], planes[own] = quats[0], 0
        normal = quaternion_to_matrix(quats[0])[:, 2]
        means[own] -= ((means[own] - means[0]) @ normal)[:, None] * normal
    cloud = SplatCloud(means, quats, scales, opacities, colors=generator.uniform(0, 1, (count, 3)))
    near = float(generator.choice([0.01, 0.01, 0.2 * middle]))
    cx, cy = generator.uniform(0.3, 0.7, 2) * [width, height]
    camera = Camera.pinhole(width, height, focal, focal, cx, cy, near=near)
    r, g, b = generator.uniform(0, 1, 3) * generator.integers(0, 2)
    background = (float(r), float(g), float(b))
    return RandomScene(cloud.with_coplanar_groups(planes) if printed else cloud, camera, background)


def _count(generator: np.random.Generator, most: int) -> int:
    return round(float(log_uniform(generator, 1, most)))


def _splats(generator: np.random.Generator, count: int, focal: float, size, middle: float, faint: bool):
    """means (n, 3), unit quats (n, 4), scales (n, 2), opacities (n,)."""
    depth = middle * np.exp(generator.uniform(-1, 1, count) * generator.uniform(0.05, 1.2))
    sideways = generator.uniform(-0.65, 0.65, (count, 2)) * size / focal * depth[:, None]
    quats = generator.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    pixels = log_uniform(generator, 0.3, max(size) / (1 if faint else 3))
    spread = generator.uniform(0.0, 1.0)
    scales = np.exp(generator.normal(math.log(pixels), spread, (count, 1))) * depth[:, None] / focal
    thin = np.exp(-generator.uniform(0, math.log(log_uniform(generator, 1, 100)), count))
    scales = np.column_stack([scales, scales * thin[:, None]])
    if faint:
        opacities = np.full(count, log_uniform(generator, 3e-4, 0.03))
    else:
        opacities = [
            generator.beta(1.2, 1.0, count),
            generator.uniform(0.9, 1.0, count),
            np.full(count, log_uniform(generator, 0.01, 1.0)),
            generator.choice([0.05, 0.5, 0.99, 1.0], count),
        ][int(generator.integers(4))]
    return np.column_stack([sideways, depth]), quats, scales, opacities
