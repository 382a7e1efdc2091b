"""Error of EWA's linear projection of a 3D Gaussian: one sphere of opacity 1 by distance and angle off the
axis, in the float64 reference renderer."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.splats.cloud import SplatCloud

DISTANCES = (3, 5, 10, 30, 100)
"""standard deviations"""
ANGLES = (0, 20, 40, 60)
"""angles off the axis in degrees"""
_SIDE, _ACROSS = 96, 4.0
"""pixels, and standard deviations from the ball's centre to the picture's edge: at 12 pixels to one EWA's 0.3
square pixels are 0.0007 of the difference"""


def linear_error(distance: float, degrees: float) -> float:
    """Largest difference of alpha between `ewa` and `exact`."""
    angle = math.radians(degrees)
    center = distance * np.array([math.sin(angle), 0.0, math.cos(angle)])
    ball = SplatCloud([center], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [1.0], colors=[[1, 1, 1]])
    # as many pixels of the image plane as the ball's picture needs, of a picture as wide as all of it
    focal = _SIDE / 2 / _ACROSS * distance * math.cos(angle) ** 2
    image = focal * math.tan(angle)
    camera = Camera.pinhole(_SIDE, _SIDE, focal, focal, _SIDE / 2 - image, _SIDE / 2, near=1e-3)
    renderer = Renderer("reference")
    ewa, exact = (
        renderer.render(ball, camera, ("alpha",), Quality(ellipsoid=way, lowpass="none"))["alpha"]
        for way in ("ewa", "exact")
    )
    return float(np.abs(ewa - exact).max())
