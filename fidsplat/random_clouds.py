"""Random clouds, each the same on every machine for the same seed.

`load_scene`: the scenes on which renderers are timed, large and like captured ones. `random_splats`: small
clouds with opacities that are hard on purpose, for tests. `random_scene`: small scenes of as many kinds as
can be, from which the table of budgets is made and with which its promise is checked. Scenes that are wrong
or extreme on purpose are those of `fidsplat.hard_cases`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.rotations import quaternion_to_matrix
from fidsplat.splats import SplatCloud

HARD_OPACITIES = np.array([0.002, 0.05, 0.3, 0.5, 0.9, 0.99, 1.0], np.float32)
MOST_SPLATS = 1500
MOST_HAZE = 600
HELD_OUT = 1_000_000
"""First seed of the random scenes that no table is made of."""


@dataclass(frozen=True)
class StandardScene:
    """A cube of random splats 8 m wide whose middle is 8 m in front of the camera."""

    count: int
    median_scale: float
    """metres"""
    width: int
    height: int
    thick: bool = False
    """whether the splats are 3D Gaussians, as those of captures are, and no disks"""


SCENES = {
    "r100k_720p": StandardScene(100_000, 0.03, 1280, 720),
    "r1m_1080p": StandardScene(1_000_000, 0.012, 1920, 1080),
    "r5m_1080p": StandardScene(5_000_000, 0.006, 1920, 1080),
    "r20m_4k": StandardScene(20_000_000, 0.004, 3840, 2160),
    "r100k_720p_3d": StandardScene(100_000, 0.03, 1280, 720, thick=True),
    "r1m_1080p_3d": StandardScene(1_000_000, 0.012, 1920, 1080, thick=True),
    "r5m_1080p_3d": StandardScene(5_000_000, 0.006, 1920, 1080, thick=True),
}
"""What is timed. The camera stands at the origin and looks down +z, x right, y down, 60 degrees across,
before black."""


def load_scene(name: str, seed: int = 0) -> tuple[SplatCloud, Camera]:
    """A scene of `SCENES` by name, with its camera."""
    scene = SCENES[name]
    cloud = random_cloud(scene.count, scene.median_scale, seed, thick=scene.thick)
    return cloud, standard_camera(scene.width, scene.height)


def standard_camera(width: int, height: int, fov_x: float = math.radians(60.0)) -> Camera:
    """The scenes' camera; fov_x in radians."""
    focal = 0.5 * width / math.tan(fov_x / 2)
    return Camera.pinhole(width, height, focal, focal, width / 2, height / 2)


def random_cloud(
    count: int, median_scale: float, seed: int = 0, extent: float = 4.0, thick: bool = False
) -> SplatCloud:
    """`count` splats: centres uniform in a cube, orientations uniform, scales log-normal, opacities beta(1.2,
    1). thick: the same with a third scale."""
    generator = np.random.default_rng(seed)
    means = generator.uniform(-extent, extent, (count, 3)).astype(np.float32)
    means[:, 2] += extent * 2.0
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
    """Splats around a camera at the origin that looks down +z, with opacities of `HARD_OPACITIES`: centres
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


@dataclass(frozen=True)
class RandomScene:
    """What is drawn, from where, and before what."""

    cloud: SplatCloud
    camera: Camera
    background: tuple[float, float, float]


def random_scene(seed: int, crossing: bool = False) -> RandomScene:
    """The scene of a seed: 1 to 2100 splats, 16 to 96 pixels wide and 12 to 72 high.

    Splats from far below a pixel to larger than the picture, of one size or of many, round or drawn out;
    opaque, of any opacity, or so faint that only hundreds of them make a haze; some printed on a plane, some
    across the near plane; cameras from wide to narrow, near and far; any background.

    Every fifth scene is printed on one plane, as a marker is, with nothing else. `crossing`: every scene is
    half printed on a plane and half not, all mixed up. There a fragment of no plane, however faint, decides
    when the plane is composited, so that the error does not go to 0 with the cut-off.
    """
    generator = np.random.default_rng([seed, 7])
    width, height = int(generator.integers(16, 97)), int(generator.integers(12, 73))
    focal = max(width, height) * float(log_uniform(generator, 0.5, 3.0))
    middle = float(log_uniform(generator, 0.5, 50.0))  # metres to the middle of the splats
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
    return RandomScene(cloud.with_planes(planes) if printed else cloud, camera, background)


def _count(generator: np.random.Generator, most: int) -> int:
    return round(float(log_uniform(generator, 1, most)))


def log_uniform(generator: np.random.Generator, low: float, high: float, shape=()) -> np.ndarray:
    """Random numbers whose logarithms are uniform."""
    return np.exp(generator.uniform(math.log(low), math.log(high), shape))


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
