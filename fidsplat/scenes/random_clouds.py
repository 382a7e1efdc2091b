"""Random clouds, identical on every machine for the same seed.

`load_scene` returns large scenes for timing, `random_splats` small clouds with extreme opacities for tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats.cloud import SplatCloud

HARD_OPACITIES = np.array([0.002, 0.05, 0.3, 0.5, 0.9, 0.99, 1.0], np.float32)


@dataclass(frozen=True)
class StandardScene:
    """A random cloud in a cube of 8 m, whose centre is 8 m in front of the camera."""

    count: int
    median_scale: float
    """metres"""
    width: int
    height: int
    thick: bool = False
    """whether the splats are 3D Gaussians, as in captures, instead of disks"""


SCENES = {
    "r100k_720p": StandardScene(100_000, 0.03, 1280, 720),
    "r1m_1080p": StandardScene(1_000_000, 0.012, 1920, 1080),
    "r5m_1080p": StandardScene(5_000_000, 0.006, 1920, 1080),
    "r20m_4k": StandardScene(20_000_000, 0.004, 3840, 2160),
    "r100k_720p_3d": StandardScene(100_000, 0.03, 1280, 720, thick=True),
    "r1m_1080p_3d": StandardScene(1_000_000, 0.012, 1920, 1080, thick=True),
    "r5m_1080p_3d": StandardScene(5_000_000, 0.006, 1920, 1080, thick=True),
}
"""Scenes for timing. The camera is at the origin, looks along +z, x right, y down, with a field of view of 60
degrees and a black background."""


def load_scene(name: str, seed: int = 0) -> tuple[SplatCloud, Camera]:
    """A scene of `SCENES` by name, with its camera."""
    scene = SCENES[name]
    cloud = random_cloud(scene.count, scene.median_scale, seed, thick=scene.thick)
    return cloud, standard_camera(scene.width, scene.height)


def standard_camera(width: int, height: int) -> Camera:
    """The camera of the scenes, with a field of view of 60 degrees."""
    focal = 0.5 * width / math.tan(math.radians(30))
    return Camera.pinhole(width, height, focal, focal, width / 2, height / 2)


def random_cloud(count: int, median_scale: float, seed: int = 0, thick: bool = False) -> SplatCloud:
    """Random splats: centres uniform in a cube of 8 m, orientations uniform, scales log-normal, opacities
    beta(1.2, 1). thick: whether they are 3D Gaussians."""
    generator = np.random.default_rng(seed)
    means = generator.uniform(-4.0, 4.0, (count, 3)).astype(np.float32)
    means[:, 2] += 8.0
    quats = generator.normal(size=(count, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(generator.normal(np.log(median_scale), 0.6, (count, 2))).astype(np.float32)
    opacities = generator.beta(1.2, 1.0, count).astype(np.float32)
    colors = generator.uniform(0, 1, (count, 3)).astype(np.float32)
    if thick:
        third = np.exp(generator.normal(np.log(median_scale), 0.6, (count, 1))).astype(np.float32)
        scales = np.concatenate([scales, third], axis=1)
    return SplatCloud(means, quats, scales, opacities, colors=colors)


def random_splats(
    count: int,
    seed: int,
    depth: tuple[float, float] = (-1.0, 6.0),
    scale: tuple[float, float] = (1e-3, 2.0),
    across: float = 2.0,
    sh_degree: int | None = None,
) -> SplatCloud:
    """Random splats around a camera at the origin that looks along +z: opacities of `HARD_OPACITIES`, centres
    uniform in a box, orientations uniform, scales log-uniform, labels 0 to 8; colours, or SH of a degree."""
    generator = np.random.default_rng(seed)
    x, y = generator.uniform(-across, across, (2, count))
    means = np.stack([x, y, generator.uniform(*depth, count)], 1).astype(np.float32)
    quats = generator.normal(size=(count, 4)).astype(np.float32)
    scales = log_uniform(generator, *scale, (count, 2)).astype(np.float32)
    opacities = generator.choice(HARD_OPACITIES, count)
    labels = generator.integers(0, 9, count)
    if sh_degree is None:
        colors = generator.uniform(0, 1, (count, 3)).astype(np.float32)
        return SplatCloud(means, quats, scales, opacities, colors=colors, labels=labels)
    sh = generator.normal(0, 0.3, (count, (sh_degree + 1) ** 2, 3)).astype(np.float32)
    return SplatCloud(means, quats, scales, opacities, sh=sh, labels=labels)


def log_uniform(generator: np.random.Generator, low: float, high: float, shape=()) -> np.ndarray:
    """Random numbers whose logarithms are uniform."""
    return np.exp(generator.uniform(math.log(low), math.log(high), shape))
