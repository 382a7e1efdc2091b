"""Small images by Blender, and the same images by the exact renderer.

    python tests/experiments/blender_images.py [ENVIRONMENT]

prints how well they agree, after drawing those in `data` that are missing with the environment of
`fidsplat experiment blender --install`.
"""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments import blender
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import BACKGROUND, BACKGROUND_LIGHT, CATEGORIES
from fidsplat.images.files import read_image
from fidsplat.markers import marker
from fidsplat.util.response import to_colors
from fidsplat.vision.metrics import psnr

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
IMAGES = {
    "tag-raw": ("apriltag", "side", "raw", "BOX"),
    "tag-standard": ("apriltag", "side", "standard", "BOX"),
    "code-raw": ("small", "front", "raw", "BOX"),
    "code-standard": ("small", "side", "standard", "BOX"),
    "tag-blackman-harris": ("apriltag", "side", "raw", "BLACKMAN_HARRIS"),
}
BOXES = tuple(name for name, shot in IMAGES.items() if shot[3] == "BOX")


def grid_of(name: str) -> np.ndarray:
    """The modules that a shot shows."""
    return marker(CATEGORIES[IMAGES[name][0]].spec(0)).grid


def ours(name: str, finer: int = 1, border: int = 0) -> np.ndarray:
    """The exact image of a shot with ``border`` more pixels around it, each divided into finer x finer:
    display values."""
    _, camera, view, _ = IMAGES[name]
    grid, camera = grid_of(name), finely(CAMERAS[camera], finer, border)
    module = EDGE / grid.shape[0]
    if view == "raw":
        return plane_image(grid, module, camera, background=BACKGROUND)
    light = plane_image(grid, module, camera, background=BACKGROUND_LIGHT)
    return to_colors(np.clip(light, 0, 1), "srgb")


def finely(camera: Camera, finer: int, border: int) -> Camera:
    """The camera with more pixels around and every pixel divided into finer x finer."""
    facts = {name: getattr(camera, name) for name in ("fx", "fy")}
    facts |= {name: getattr(camera, name) + 2 * border for name in ("width", "height")}
    facts |= {name: getattr(camera, name) + border for name in ("cx", "cy")}
    return replace(camera, **{name: value * finer for name, value in facts.items()})


def flat(name: str, room: int) -> np.ndarray:
    """(h, w) bool: pixels whose neighbours up to ``room`` away show one value."""
    image = ours(name)
    same = np.ones(image.shape, bool)
    for dy in range(-room, room + 1):
        for dx in range(-room, room + 1):
            same &= np.abs(np.roll(image, (dy, dx), (0, 1)) - image) < 1e-9
    same[:room], same[-room:], same[:, :room], same[:, -room:] = (False,) * 4
    return same


def theirs(name: str) -> np.ndarray:
    """Blender's image of a shot: display values."""
    return read_image(DATA / f"{name}.png")[:, :, 0] / 255.0


def blackman_harris(name: str, finer: int = 16) -> np.ndarray:
    """Our image under the Blackman-Harris window of 3 pixels, Blender's filter of width 1.5."""
    fine = ours(name, finer, border=1)
    x = (np.arange(3 * finer) + 0.5) / finer - 1.5
    turn = 2 * np.pi * (x / 3 + 0.5)
    weight = 0.35875 - 0.48829 * np.cos(turn) + 0.14128 * np.cos(2 * turn) - 0.01168 * np.cos(3 * turn)
    weight /= weight.sum()
    rows = np.stack([weight @ fine[i * finer : (i + 3) * finer] for i in range(HEIGHT)])
    return np.stack([rows[:, j * finer : (j + 3) * finer] @ weight for j in range(WIDTH)], 1)


def compare() -> None:
    """Print PSNR in dB of each shot, inside cells and at edges."""
    for name in IMAGES:
        inside = flat(name, 2)
        pictures = {"": ours(name)}
        if name not in BOXES:
            pictures[", our picture under that filter"] = blackman_harris(name)
        for what, image in pictures.items():
            ratios = [psnr(image[where], theirs(name)[where]) for where in (inside, ~inside)]
            print(f"{name}{what}: {ratios[0]:.1f} inside cells, {ratios[1]:.1f} at edges")


def draw(environment: Path) -> None:
    """Render missing images."""
    for name, (_, camera, view, pixel_filter) in IMAGES.items():
        grid = grid_of(name)
        shot = blender.image_job(DATA / f"{name}.png", CAMERAS[camera])
        job = {"name": name, "grid": grid.tolist(), "module": EDGE / grid.shape[0], "images": [shot]}
        for file in blender.render([job], view, environment, SAMPLES, pixel_filter):
            print(file)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        draw(Path(sys.argv[1]))
    compare()
