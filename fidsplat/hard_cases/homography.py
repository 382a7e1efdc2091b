"""Splats seen almost from their edge, near the corner of a picture 8192 pixels wide: how wrong their Gaussian
is.
"""

from __future__ import annotations

import math

import numpy as np

from fidsplat.hard_cases.agreement import Picture, draw, truth_of
from fidsplat.hard_cases.clouds import camera, quaternion, splats
from fidsplat.quality import Quality
from fidsplat.render import Renderer

WIDTH, HEIGHT, FOCAL = 8192, 5461, 6400.0
QUALITY = Quality(lowpass="none", alpha_cutoff=1e-6)
"""the Gaussian alone, to 5.3 standard deviations, so that no rim lies where it is measured"""


def grazing_errors(renderer: Renderer, tilt: float, sigma: int, quality: Quality = QUALITY) -> np.ndarray:
    """Errors of G (k,) in at most 4,000 pixels within 3.3 standard deviations of opaque splats.

    The splats stand in a strip at the lower right corner, of which only the strip is drawn. tilt: degrees
    between the splat's normal and the ray to its centre. sigma: standard deviation in pixels of the untilted
    splat.
    """
    generator = np.random.default_rng(int(tilt * 10) + sigma)
    cell = math.ceil(11 * sigma)
    rows = 4 if sigma < 10 else 1
    columns = 3200 // cell
    strip = rows * cell
    view = camera(WIDTH, strip, FOCAL, cy=HEIGHT / 2 - (HEIGHT - strip))
    flatness = math.cos(math.radians(tilt))
    means, quats, scales = [], [], []
    for j in range(rows):
        for i in range(columns):
            # beside a pixel's centre by up to the width of the line that a grazing splat becomes
            x, y = (
                (np.array([WIDTH - (i + 1) * cell, j * cell]) + cell // 2)
                + 0.5
                + generator.uniform(-1.5, 1.5, 2) * min(1.0, sigma * flatness)
            )
            ray = np.array([(x - view.cx) / FOCAL, (y - view.cy) / FOCAL, 1.0])
            depth = generator.uniform(3, 60)
            means.append(ray * depth)
            quats.append(_tilted(generator, ray, tilt, flatness))
            scales.append(sigma * depth / FOCAL)
    cloud = splats(np.asarray(means, np.float32), quats, np.asarray(scales)[:, None])
    picture = Picture(cloud, view, quality, ("rgb", "alpha"))
    alpha = draw(renderer, picture)["alpha"]
    drawn = np.nonzero(alpha > 0)
    some = generator.permutation(len(drawn[0]))[:4000]
    drawn = drawn[0][some], drawn[1][some]
    truth = truth_of(picture, drawn)["alpha"]
    errors = np.abs(alpha[drawn] - truth)[truth > 0.004]
    return errors


def _tilted(generator: np.random.Generator, ray: np.ndarray, tilt: float, flatness: float) -> np.ndarray:
    """Quaternion (4,). The tangent that keeps its length runs from pixel centre to pixel centre, to within
    flatness."""
    along = generator.choice([[1, 0], [0, 1], [1, 1], [2, 1], [-1, 2], [3, -1], [-2, 3], [4, 3]]).astype(
        float
    )
    along += generator.uniform(-2, 2, 2) * flatness
    # the direction in the camera's frame that moves along `along` in the picture, at right angles to the ray
    w = -(along @ ray[:2]) / (ray @ ray)
    tangent = np.array([*(along + ray[:2] * w), w])
    tangent /= np.linalg.norm(tangent)
    along = ray / np.linalg.norm(ray)
    angle = math.radians(tilt)
    normal = math.cos(angle) * along + math.sin(angle) * np.cross(tangent, along)
    return quaternion(tangent, np.cross(normal, tangent))
