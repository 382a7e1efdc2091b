"""Scenes of any input: scene files, splat files and stores, which get a camera that frames them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.formats.collect import Progress
from fidsplat.formats.files import FORMATS, NAMED, load_splats
from fidsplat.scenes.scene import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.layout import SUFFIX
from fidsplat.store.store import Store
from fidsplat.util.errors import InputError

WIDTH, HEIGHT, FOV_X = 1280, 720, math.radians(60.0)
MARGIN = 1.1
REACH = 1.5
"""standard deviations of a splat that must be visible; with 3, faint tails would set the camera's distance"""
MANY = 10_000
"""captured scenes have strays far away: a cloud of this many is framed without the outermost 1 % of its
splats"""


def load_source(source: str, quality: Quality | str | None = None, progress: Progress | None = None) -> Scene:
    """Load a scene file, or a splat file or store with a camera that frames it.

    Raises:
        InputError: another kind of file; a scene without a camera.
    """
    suffix = Path(source).suffix.lower()
    if suffix == ".toml":
        scene = Scene.load(source, quality, progress)
        if scene.camera is None:
            raise InputError(
                f"{source} must have a [camera] table; add one with width, height, fov_x_deg, position, "
                "look_at"
            )
        return scene
    if suffix == SUFFIX:
        store = Store(source)
        return Scene(stores=(store,), camera=framing_camera(store))
    if suffix in FORMATS or Path(source).name.lower() in NAMED:
        cloud = load_splats(source, progress)
        return Scene((cloud,), camera=framing_camera(cloud))
    raise InputError(
        f"the source must be a scene file (.toml), a store ({SUFFIX}) or a splat file "
        f"({', '.join([*FORMATS, *NAMED])}), got {source}"
    )


def framing_camera(cloud: SplatCloud | Store) -> Camera:
    """A camera on the -z side, y down, with all splats in view; 1280 x 720 pixels, 60 degrees wide."""
    low, high = _extent(cloud)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    tangent = math.tan(FOV_X / 2)
    away = MARGIN * max(half[0] / tangent, half[1] / (tangent * HEIGHT / WIDTH)) + half[2]
    return Camera.look_at(WIDTH, HEIGHT, FOV_X, middle - [0, 0, away], middle, near=min(0.01, away / 100))


def _extent(cloud: SplatCloud | Store) -> tuple[np.ndarray, np.ndarray]:
    if len(cloud) == 0:
        return -np.ones(3), np.ones(3)
    if isinstance(cloud, Store):  # bounds of its chunks, which are small compared with the scene
        return cloud.bounds(REACH)
    reach = cloud.reach(REACH)
    share = 0.5 if len(cloud) >= MANY else 0.0
    low = np.percentile(cloud.means - reach, share, axis=0)
    high = np.percentile(cloud.means + reach, 100 - share, axis=0)
    return low + cloud.origin, high + cloud.origin
