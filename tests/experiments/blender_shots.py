"""Small pictures by Blender, and what the exact renderer makes of the same.

    python tests/experiments/blender_shots.py ENVIRONMENT

draws those in `data` that are missing, with the environment of `fidsplat experiment blender --install`.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments import blender
from fidsplat.experiments.methods import plain_marker
from fidsplat.experiments.plane import plane_picture
from fidsplat.experiments.setup import BACKGROUND, CATEGORIES
from fidsplat.experiments.views import from_srgb, srgb

DATA = Path(__file__).parent / "data"
SAMPLES = 1024
EDGE = 2.0  # metres, of the plane
WIDTH, HEIGHT = 120, 88

_FRONT = np.eye(4)
_FRONT[:3, 3] = 0.13, -0.07, 4.0
CAMERAS = {
    "front": Camera.pinhole(WIDTH, HEIGHT, 150.0, 150.0, 57.3, 45.1, _FRONT),
    "side": Camera.look_at(WIDTH, HEIGHT, math.radians(40), (2.4, -1.7, -2.6), (0.1, 0.0, 0.0)),
}
# name: category, camera, view, pixel filter
SHOTS = {
    "tag-raw": ("apriltag", "side", "raw", "BOX"),
    "tag-standard": ("apriltag", "side", "standard", "BOX"),
    "code-raw": ("small", "front", "raw", "BOX"),
    "code-standard": ("small", "side", "standard", "BOX"),
    "tag-blackman-harris": ("apriltag", "side", "raw", "BLACKMAN_HARRIS"),
}
BOXES = tuple(name for name, shot in SHOTS.items() if shot[3] == "BOX")


def grid_of(name: str) -> np.ndarray:
    """The modules that a shot shows."""
    return plain_marker(CATEGORIES[SHOTS[name][0]].spec(0)).grid


def ours(name: str, finer: int = 1) -> np.ndarray:
    """The exact picture of a shot, each pixel divided into finer x finer: display values."""
    _, camera, view, _ = SHOTS[name]
    grid, camera = grid_of(name), finely(CAMERAS[camera], finer)
    module = EDGE / grid.shape[0]
    if view == "raw":
        return plane_picture(grid, module, camera, background=BACKGROUND)
    return srgb(plane_picture(grid, module, camera, background=from_srgb(BACKGROUND)))


def finely(camera: Camera, finer: int) -> Camera:
    """The camera with every pixel divided into finer x finer."""
    scaled = {name: getattr(camera, name) * finer for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return replace(camera, **scaled)


def flat(name: str, room: int) -> np.ndarray:
    """(h, w) bool: pixels whose neighbours up to ``room`` away show one value."""
    picture = ours(name)
    same = np.ones(picture.shape, bool)
    for dy in range(-room, room + 1):
        for dx in range(-room, room + 1):
            same &= np.abs(np.roll(picture, (dy, dx), (0, 1)) - picture) < 1e-9
    same[:room], same[-room:], same[:, :room], same[:, -room:] = (False,) * 4
    return same


def main(environment: Path) -> None:
    """Draw what is missing."""
    for name, (_, camera, view, pixel_filter) in SHOTS.items():
        grid = grid_of(name)
        shot = {"file": str(DATA / f"{name}.png"), **blender.camera_facts(CAMERAS[camera])}
        job = {"name": name, "grid": grid.tolist(), "module": EDGE / grid.shape[0], "shots": [shot]}
        for file in blender.render([job], view, environment, SAMPLES, pixel_filter):
            print(file)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
