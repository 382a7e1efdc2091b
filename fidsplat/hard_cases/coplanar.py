"""Splats printed on one plane, seen by a camera that turns by hardly anything: how far a pixel jumps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.hard_cases.agreement import Picture, draw
from fidsplat.hard_cases.clouds import quaternion, splats, turned
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.rotations import quaternion_to_matrix
from fidsplat.splats import SplatCloud

STEP = math.radians(1e-4)
WALL_STEP = math.radians(1e-3)
"""radians per picture; larger before a wall, whose splats change places more seldom"""
SMOOTH = 1e-3
"""largest change of a pixel in a step of 1e-4 degrees that is none of order: edges move"""


def tag(side: int = 8, seed: int = 0) -> SplatCloud:
    """A marker-like cloud on the plane z = 0, 1 m wide: black and white modules whose splats overlap."""
    generator = np.random.default_rng(seed)
    bits = generator.integers(0, 2, (side, side))
    bits[[0, -1]] = bits[:, [0, -1]] = 0
    rows, columns = (grid.ravel() for grid in np.mgrid[0:side, 0:side])
    means = np.column_stack([(columns + 0.5) / side - 0.5, (rows + 0.5) / side - 0.5, np.zeros(side**2)])
    grey = np.repeat(bits.ravel()[:, None], 3, axis=1)
    return splats(means, (1, 0, 0, 0), 0.45 / side, 0.9, grey).with_planes(0)


def wall(count: int = 2000, away: float = 0.05, seed: int = 1) -> SplatCloud:
    """Grey splats of opacity 0.9, of no plane, that cover 3 x 3 m from z = `away` to 2 cm behind it."""
    generator = np.random.default_rng(seed)
    depth = generator.uniform(away, away + 0.02, count)
    means = np.column_stack([generator.uniform(-1.5, 1.5, (count, 2)), depth])
    scales = generator.uniform(0.5, 1.5, (count, 2)) * 2.7 / math.sqrt(count)
    grey = np.repeat(generator.uniform(0, 1, (count, 1)), 3, axis=1)
    return splats(means.astype(np.float32), (1, 0, 0, 0), scales, 0.9, grey)


def turning(
    cloud: SplatCloud,
    order: str,
    steps: int = 8,
    tilt: float = 0.0,
    width: int = 96,
    height: int = 80,
    step: float = STEP,
) -> Iterator[Picture]:
    """Pictures of a tag 1 m wide from 1.6 m, the camera turning about it in steps of `step` radians.

    It goes round it and rises with it, and is level with its middle halfway. tilt: degrees about the vertical
    axis halfway; 0 is face to face.
    """
    quality = Quality(order=order)
    for number in range(-steps, steps + 1):
        rise = (number + 0.5) * step
        round_it, level = math.radians(tilt) + rise, 1.6 * math.cos(rise)
        position = -level * math.sin(round_it), -1.6 * math.sin(rise), -level * math.cos(round_it)
        camera = Camera.look_at(width, height, 0.8, position, (0, 0, 0))
        yield Picture(cloud, camera, quality, ("rgb",))


def beside_a_big_splat(where: str) -> tuple[SplatCloud, SplatCloud]:
    """A tag, and a big slanted splat `before` it, `behind` it or `through` it. By its centre alone it would
    be on the other side.
    """
    middle, slide = {"before": (-0.75, -1.3), "behind": (0.75, 1.3), "through": (0.0, 0.7)}[where]
    along = np.array([math.cos(math.radians(50)), 0, -math.sin(math.radians(50))])
    center = np.array([0, 0, middle]) + slide * along
    big = splats([center], quaternion(along, (0, 1, 0)), 0.9, 0.8, (0.9, 0.5, 0.2))
    return tag(6), big


def fan(count: int = 40, seed: int = 5) -> SplatCloud:
    """Splats 2 m wide that all pass through one line, 3 m away: each is in front of every other somewhere."""
    generator = np.random.default_rng(seed)
    quats = np.array([turned((0, 1, 0), angle) for angle in np.linspace(-75, 75, count)])
    means = np.tile([0.0, 0.0, 3.0], (count, 1))
    return splats(means, quats, (0.35, 0.5), generator.uniform(0.1, 0.9, count), generator.random((count, 3)))


def layered(
    renderer: Renderer, parts: Sequence[SplatCloud], camera: Camera, order: str = "auto"
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds of one plane or one splat each, drawn together, and composited pixel by pixel from pictures of
    each alone, by their depths there (both (h, w, 3)). 0 where two depths agree to 1e-4.
    """
    # with a cut-off above 1/255 all that is drawn has a depth
    quality = Quality(alpha_cutoff=1 / 250, transmittance_stop=0.0, order=order)
    outputs = ("rgb", "alpha", "depth")
    alone = [draw(renderer, Picture(part, camera, quality, outputs, (0, 0, 0))) for part in parts]
    whole = Picture(SplatCloud.concatenate(parts), camera, quality, outputs, (0, 0, 0))
    rgb, alpha, depth = (np.stack([frame[name] for frame in alone]) for name in outputs)
    order = np.argsort(np.where(alpha > 0, depth, np.inf), axis=0)
    light, wanted = np.ones(alpha.shape[1:]), np.zeros(rgb.shape[1:])
    for k in order:
        index = k[None]
        wanted += light[..., None] * np.take_along_axis(rgb, index[..., None], 0)[0]
        light *= 1 - np.take_along_axis(alpha, index, 0)[0]
    ranked = np.sort(np.where(alpha > 0, depth, np.inf), axis=0)
    with np.errstate(invalid="ignore"):
        clear = 1.0 - np.any(np.diff(ranked, axis=0) < 1e-4, axis=0)[..., None]
    return draw(renderer, whole)["rgb"] * clear, wanted * clear


def faint_between(opacity: float) -> Picture:
    """A black and a white splat on a plane tilted by 40 degrees, and a faint one of no plane whose centre's
    depth lies between those of theirs.
    """
    turn = turned((0, 1, 0), 40)
    along = quaternion_to_matrix(turn)[:, 0]
    means = [(0, 0, 2) - 0.1 * along, (0, 0, 2) + 0.1 * along, (0, 0, 2)]
    colors = [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5)]
    cloud = splats(means, turn, 0.15, [0.9, 0.9, opacity], colors).with_planes([0, 0, -1])
    return Picture(cloud, Camera.pinhole(33, 33, 60.0, 60.0, 16.5, 16.5), outputs=("rgb",))


def largest_jump(renderer: Renderer, pictures: Iterator[Picture]) -> tuple[float, np.ndarray, np.ndarray]:
    """Largest change of a pixel from one picture to the next, and the two pictures (h, w, 3)."""
    worst = -1.0, np.zeros(0), np.zeros(0)
    last = None
    for picture in pictures:
        rgb = draw(renderer, picture)["rgb"]
        if last is not None and (jump := float(np.abs(rgb - last).max())) > worst[0]:
            worst = jump, last, rgb
        last = rgb
    return worst
