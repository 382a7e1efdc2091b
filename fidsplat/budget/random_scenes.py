"""Random scenes of many kinds, each from its seed alone: what the shipped table is made of, and what its
promise is held against.

Splats from far below a pixel to larger than the picture, of one size or of many, round or drawn out; opaque, of
any opacity, or so faint that only hundreds of them make a haze; some on printed planes, some across the near
plane; cameras from wide to narrow, near and far, before any colour.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats import SplatCloud

MOST_SPLATS = 1500
MOST_HAZE = 600
HELD_OUT = 1_000_000
"""First seed of the scenes that no table is made of."""


@dataclass(frozen=True)
class RandomScene:
    """What is drawn, from where, and before what."""

    cloud: SplatCloud
    camera: Camera
    background: tuple[float, float, float]


def random_scene(seed: int) -> RandomScene:
    """The scene of a seed: 1 to 2100 splats, 16 to 96 pixels wide and 12 to 72 high."""
    generator = np.random.default_rng([seed, 7])
    width, height = int(generator.integers(16, 97)), int(generator.integers(12, 73))
    focal = max(width, height) * _log_uniform(generator, 0.5, 3.0)
    middle = _log_uniform(generator, 0.5, 50.0)  # metres to the middle of the splats
    solid = _splats(generator, _count(generator, MOST_SPLATS), focal, (width, height), middle, faint=False)
    parts = [solid]
    if generator.random() < 0.4:
        parts.append(
            _splats(generator, _count(generator, MOST_HAZE), focal, (width, height), middle, faint=True)
        )
    means, quats, scales, opacities = (np.concatenate([part[k] for part in parts]) for k in range(4))
    count = len(means)
    planes = np.full(count, -1)
    if generator.random() < 0.25:  # splats printed on a plane
        own = np.flatnonzero(generator.random(count) < 0.5)
        if len(own):
            quats[own], planes[own] = quats[own[0]], 0
            normal = _normal(quats[own[0]])
            means[own] -= ((means[own] - means[own[0]]) @ normal)[:, None] * normal
    cloud = SplatCloud(means, quats, scales, opacities, colors=generator.uniform(0, 1, (count, 3)))
    cloud = cloud.with_planes(planes) if (planes >= 0).any() else cloud
    near = float(generator.choice([0.01, 0.01, 0.2 * middle]))
    cx, cy = generator.uniform(0.3, 0.7, 2) * [width, height]
    camera = Camera.pinhole(width, height, focal, focal, cx, cy, near=near)
    r, g, b = generator.uniform(0, 1, 3) * generator.integers(0, 2)
    return RandomScene(cloud, camera, (float(r), float(g), float(b)))


def _count(generator: np.random.Generator, most: int) -> int:
    return round(_log_uniform(generator, 1, most))


def _log_uniform(generator: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(generator.uniform(math.log(low), math.log(high))))


def _normal(quat: np.ndarray) -> np.ndarray:
    """(3,) third axis of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def _splats(generator: np.random.Generator, count: int, focal: float, size, middle: float, faint: bool):
    """means (n, 3), unit quats (n, 4), scales (n, 2), opacities (n,)."""
    depth = middle * np.exp(generator.uniform(-1, 1, count) * generator.uniform(0.05, 1.2))
    sideways = generator.uniform(-0.65, 0.65, (count, 2)) * size / focal * depth[:, None]
    quats = generator.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    pixels = _log_uniform(generator, 0.3, max(size) / (1 if faint else 3))
    spread = generator.uniform(0.0, 1.0)
    scales = np.exp(generator.normal(math.log(pixels), spread, (count, 1))) * depth[:, None] / focal
    thin = np.exp(-generator.uniform(0, math.log(_log_uniform(generator, 1, 100)), count))
    scales = np.column_stack([scales, scales * thin[:, None]])
    if faint:
        opacities = np.full(count, _log_uniform(generator, 3e-4, 0.03))
    else:
        opacities = [
            generator.beta(1.2, 1.0, count),
            generator.uniform(0.9, 1.0, count),
            np.full(count, _log_uniform(generator, 0.01, 1.0)),
            generator.choice([0.05, 0.5, 0.99, 1.0], count),
        ][int(generator.integers(4))]
    return np.column_stack([sideways, depth]), quats, scales, opacities
