"""Measure the error of EWA's linear projection of a 3D Gaussian, for the table of docs/primitives.md.

    python benchmarks/ewa_error.py

Renders one opaque sphere at several distances and angles off the axis with the float64 reference renderer.
"""

from __future__ import annotations

import math

import numpy as np
import pandas as pd

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud

DISTANCES = (3, 5, 10, 30, 100)
"""standard deviations"""
ANGLES = (0, 20, 40, 60)
"""angles off the axis in degrees"""
_SIDE, _EXTENT = 96, 4.0
"""pixels, and standard deviations from the centre of the sphere to the edge of the image: at 12 pixels per
standard deviation, the widening by 0.3 square pixels is 0.0007 of the difference"""


def linear_error(distance: float, degrees: float) -> float:
    """Largest difference of alpha between `ewa` and `exact`."""
    angle = math.radians(degrees)
    center = distance * np.array([math.sin(angle), 0.0, math.cos(angle)])
    sphere = SplatCloud([center], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [1.0], colors=[[1, 1, 1]])
    focal = _SIDE / 2 / _EXTENT * distance * math.cos(angle) ** 2
    offset = focal * math.tan(angle)
    camera = Camera.pinhole(_SIDE, _SIDE, focal, focal, _SIDE / 2 - offset, _SIDE / 2, near=1e-3)
    renderer = Renderer("reference")
    ewa, exact = (
        renderer.render(sphere, camera, ("alpha",), Quality(ellipsoid=name, lowpass="none"))["alpha"]
        for name in ("ewa", "exact")
    )
    return float(np.abs(ewa - exact).max())


if __name__ == "__main__":
    table = {angle: [linear_error(distance, angle) for distance in DISTANCES] for angle in ANGLES}
    print(pd.DataFrame(table, index=DISTANCES).to_string(float_format="%.2g"))
