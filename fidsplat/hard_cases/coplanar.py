"""Splats printed on one plane, seen by a camera that turns by hardly anything: how far a pixel jumps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.hard_cases.agreement import Picture
from fidsplat.hard_cases.clouds import splats
from fidsplat.hard_cases.invariance import draw
from fidsplat.quality import Quality
from fidsplat.render import Renderer
from fidsplat.splats import SplatCloud

STEP = math.radians(1e-4)


def tag(side: int = 8, seed: int = 0) -> SplatCloud:
    """A marker-like cloud on the plane z = 0, 1 m wide: black and white modules whose splats overlap."""
    generator = np.random.default_rng(seed)
    bits = generator.integers(0, 2, (side, side))
    bits[[0, -1]] = bits[:, [0, -1]] = 0
    rows, columns = (grid.ravel() for grid in np.mgrid[0:side, 0:side])
    means = np.column_stack([(columns + 0.5) / side - 0.5, (rows + 0.5) / side - 0.5, np.zeros(side**2)])
    grey = np.repeat(bits.ravel()[:, None], 3, axis=1)
    return splats(means, (1, 0, 0, 0), 0.45 / side, 0.9, grey).with_planes(0)


def turning(
    cloud: SplatCloud, coplanar: str, steps: int = 8, tilt: float = 0.0, width: int = 96, height: int = 80
) -> Iterator[Picture]:
    """Pictures of a tag 1 m wide from 1.6 m, the camera turning about it in steps of 1e-4 degrees.

    It goes round it and rises with it, and is level with its middle halfway. tilt: degrees about the vertical
    axis halfway; 0 is face to face.
    """
    quality = Quality(coplanar=coplanar)
    for step in range(-steps, steps + 1):
        rise = (step + 0.5) * STEP
        round_it, level = math.radians(tilt) + rise, 1.6 * math.cos(rise)
        position = -level * math.sin(round_it), -1.6 * math.sin(rise), -level * math.cos(round_it)
        camera = Camera.look_at(width, height, 0.8, position, (0, 0, 0))
        yield Picture(cloud, camera, quality, ("rgb",))


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
