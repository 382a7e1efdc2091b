"""Training data set of the demo scene: images from an arc, their cameras, and noisy points."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import write_png
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import Scene
from fidsplat.util.files import atomic_write, writable_folder
from fidsplat.worlds.yard import FOV_X, demo_scene

POINTS = 6000
_SPREAD = 0.005
"""standard deviation of points in metres"""
_TARGET = (0.0, 0.1, 0.3)
_ARC = math.radians(50.0)
"""half angle of the arc"""


def write_demo_views(
    folder: str | Path,
    views: int = 30,
    test: int = 6,
    width: int = 320,
    seed: int = 0,
    device: str | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Path:
    """Render the demo scene from many poses and write the data set (`fidsplat.train.load_dataset`).

    Args:
        views: number of training images; test: number of test images, in the folder test.
        width: width of an image in pixels; the aspect ratio is 16 : 9.

    Raises:
        InputError: the folder cannot be written; DeviceError: the device cannot be used.
    """
    folder = writable_folder(folder)
    scene, renderer = demo_scene(seed), Renderer(device)
    resident, done = renderer.upload(scene), 0
    for out, stem, cameras in (
        (folder, "view", _cameras(views, width, 0.0)),
        (folder / "test", "test", _cameras(test, width, 0.5)),
    ):
        writable_folder(out / "images")
        names = [f"{stem}-{i:02d}.png" for i in range(len(cameras))]
        frames = renderer.render_views(resident, cameras, outputs="rgb", quality="standard,samples=3")
        for name, frame in zip(names, frames, strict=True):
            write_png(out / "images" / name, frame["rgb"])
            done += 1
            if progress is not None:
                progress("images", done / (views + test))
        save_colmap(out / "sparse" / "0", names, cameras, *_points(scene, seed))
    # written last, since it marks a complete data set
    with atomic_write(folder / "dataset.json") as stream:
        stream.write(json.dumps({"background": scene.background, "seed": seed}).encode())
    return folder


def _cameras(count: int, width: int, shift: float) -> list[Camera]:
    """Cameras on an arc with alternating distances and heights.

    shift: 0.5 places cameras between those of 0.
    """
    height = round(width * 9 / 16)
    cameras = []
    for i in range(count):
        angle = _ARC * (2 * (i + shift + 0.25) / count - 1)
        distance, up = 2.2 + 0.3 * math.cos(2.4 * (i + shift)), 0.25 + 0.3 * math.sin(1.7 * (i + shift))
        offset = (distance * math.sin(angle), -up, -distance * math.cos(angle))
        cameras.append(Camera.look_at(width, height, FOV_X, np.add(_TARGET, offset), _TARGET))
    return cameras


def _points(scene: Scene, seed: int) -> tuple[np.ndarray, np.ndarray]:
    cloud = scene.cloud()
    random = np.random.default_rng(seed)
    rows = np.sort(random.choice(len(cloud), POINTS, replace=False))
    points = cloud.world_means()[rows] + random.normal(0, _SPREAD, (POINTS, 3))
    colors = cloud.plain_colors
    assert colors is not None  # the demo scene has plain colours
    return points, np.rint(np.clip(colors[rows], 0, 1) * 255).astype(np.uint8)
