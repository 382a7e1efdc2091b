"""The standard random scenes on which renderers are timed and compared: same seed in, same splats out.

Camera at the origin, looking down +z, x right, y down, horizontal field of view 60 degrees, black background.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.splats import SplatCloud


@dataclass(frozen=True)
class RandomScene:
    """A cube of random splats 8 m wide whose middle is 8 m in front of the camera."""

    count: int
    median_scale: float
    """metres"""
    width: int
    height: int


SCENES = {
    "r100k_720p": RandomScene(100_000, 0.03, 1280, 720),
    "r1m_1080p": RandomScene(1_000_000, 0.012, 1920, 1080),
    "r5m_1080p": RandomScene(5_000_000, 0.006, 1920, 1080),
    "r20m_4k": RandomScene(20_000_000, 0.004, 3840, 2160),
}


def random_cloud(count: int, median_scale: float, seed: int = 0, extent: float = 4.0) -> SplatCloud:
    """`count` splats: uniform centres, random orientations, log-normal scales, beta(1.2, 1) opacities."""
    generator = np.random.default_rng(seed)
    means = generator.uniform(-extent, extent, (count, 3)).astype(np.float32)
    means[:, 2] += extent * 2.0
    quats = generator.normal(size=(count, 4)).astype(np.float32)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(generator.normal(np.log(median_scale), 0.6, (count, 2))).astype(np.float32)
    opacities = generator.beta(1.2, 1.0, count).astype(np.float32)
    colors = generator.uniform(0, 1, (count, 3)).astype(np.float32)
    return SplatCloud(means, quats, scales, opacities, colors=colors)


def standard_camera(width: int, height: int, fov_x: float = math.radians(60.0)) -> Camera:
    """The scenes' camera; fov_x in radians."""
    focal = 0.5 * width / math.tan(fov_x / 2)
    return Camera.pinhole(width, height, focal, focal, width / 2, height / 2)


def load_scene(name: str, seed: int = 0) -> tuple[SplatCloud, Camera]:
    """A scene of `SCENES` by name, with its camera."""
    scene = SCENES[name]
    cloud = random_cloud(scene.count, scene.median_scale, seed)
    return cloud, standard_camera(scene.width, scene.height)
