"""Slanted and curved edges of drawings in images."""

import math
from pathlib import Path

import numpy as np
import pytest
import shapely
from agreement import ALL_OUTPUTS

import fidsplat as fs

SIGN = Path(__file__).parents[2] / "examples" / "data" / "sign.svg"


@pytest.mark.sweep
def test_a_drawing_is_as_smooth_as_its_outlines(renderer):
    """At 8 px a stroke (16 x 16 places in each pixel): 40 dB, where modules alone have 21; nothing behind it
    shows through."""
    marker = fs.marker(f"svg-64:{SIGN}")
    scale = 160 / 64
    height, width = (round(side * scale) for side in marker.grid.shape)
    camera = fs.Camera.pinhole(width, height, 4.0 * width, 4.0 * width, width / 2, height / 2, pose_at(4.0))
    green, quality = (0.0, 1.0, 0.0), fs.Quality(lowpass="none")
    frame = renderer.render(marker.cloud, camera, ALL_OUTPUTS, quality, background=green)
    y, x = (np.indices((height * 16, width * 16)) + 0.5) / 16 / scale
    ideal = np.zeros((height, width, 3))
    for color, region in zip(marker.palette, marker.regions, strict=True):
        shapely.prepare(region)
        inside = shapely.intersects_xy(region, x, y).reshape(height, 16, width, 16).mean((1, 3))
        ideal += inside[..., None] * color
    psnr = -10 * math.log10(float(((frame["rgb"] - ideal) ** 2).mean()))
    print(f"{psnr:.1f} dB, alpha {frame['alpha'].min():.4f}")
    assert psnr > 40
    assert frame["alpha"].min() > 0.99


def pose_at(away: float) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = away
    return pose
