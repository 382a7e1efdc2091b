"""What EWA's linear image of a 3D Gaussian is wrong by: the largest difference in alpha from the largest
value along each ray, of one ball of opacity 1, by its distance and its angle off the axis.

    python benchmarks/ewa_error.py

The float64 reference draws both, at 12 pixels to a standard deviation: EWA's 0.3 square pixels are 0.0007 of
the difference.
"""

import math

import numpy as np
from rich.console import Console
from rich.table import Table

import fidsplat as fs

DISTANCES = (3, 5, 10, 30, 100)  # standard deviations
ANGLES = (0, 20, 40, 60)  # degrees off the axis
SIDE, ACROSS = 96, 4.0  # pixels, and standard deviations from the ball's centre to the picture's edge


def error(distance: float, degrees: float) -> float:
    """The largest difference in alpha."""
    angle = math.radians(degrees)
    center = distance * np.array([math.sin(angle), 0.0, math.cos(angle)])
    ball = fs.SplatCloud([center], [[1, 0, 0, 0]], [[1.0, 1.0, 1.0]], [1.0], colors=[[1, 1, 1]])
    # as many pixels of the image plane as the ball's picture needs, of a picture as wide as all of it
    focal = SIDE / 2 / ACROSS * distance * math.cos(angle) ** 2
    image = focal * math.tan(angle)
    camera = fs.Camera.pinhole(SIDE, SIDE, focal, focal, SIDE / 2 - image, SIDE / 2, near=1e-3)
    renderer = fs.Renderer("reference")
    ewa, exact = (
        renderer.render(ball, camera, ("alpha",), fs.Quality(ellipsoid=way, lowpass="none"))["alpha"]
        for way in ("ewa", "exact")
    )
    return float(np.abs(ewa - exact).max())


def main() -> None:
    table = Table("distance", *(f"{angle} degrees off the axis" for angle in ANGLES))
    for distance in DISTANCES:
        table.add_row(f"{distance} sigma", *(f"{error(distance, angle):.2g}" for angle in ANGLES))
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
