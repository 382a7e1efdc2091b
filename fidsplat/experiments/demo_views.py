"""Training data set of the demo scene: images from an arc, their cameras, and noisy points."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import write_png
from fidsplat.scenes import Scene
from fidsplat.util.arguments import whole_number
from fidsplat.util.files import writable_folder, write_json
from fidsplat.util.progress import Progress
from fidsplat.worlds.yard import FOV_X, demo_scene

POINTS = 6000
_SPREAD = 0.005
"""standard deviation of points in metres"""
_TARGET = (0.0, 0.1, 0.3)
_ARC = math.radians(50.0)
"""half angle of the arc"""


@dataclass(frozen=True)
class DemoViewSettings:
    """Images of the data set.

    Raises:
        InputError: a number is out of its range.
    """

    views: int = 30
    """number of training images, 2 to 1000"""
    test: int = 6
    """number of test images, 1 to 1000"""
    width: int = 320
    """width of an image in pixels, 64 to 4096; the aspect ratio is 16 : 9"""
    seed: int = 0
    """seed of the scene and its points"""

    def __post_init__(self) -> None:
        ranges = {"views": (2, 1000), "test": (1, 1000), "width": (64, 4096), "seed": (0, 2**32 - 1)}
        for name, (lowest, highest) in ranges.items():
            whole_number(f"--{name}", getattr(self, name), lowest, highest)


def write_demo_views(
    folder: str | Path,
    settings: DemoViewSettings | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> Path:
    """Render the demo scene from many poses and write a data set for training.

    Raises:
        InputError: the folder cannot be written; DeviceError: the device cannot be used.
    """
    from fidsplat.render.renderer import Renderer

    settings = settings or DemoViewSettings()
    views, test, width, seed = settings.views, settings.test, settings.width, settings.seed
    folder = writable_folder(folder)
    scene, renderer = demo_scene(seed), Renderer(device)
    resident, done = renderer.upload(scene), 0
    for out, stem, cameras in (
        (folder, "view", _cameras(views, width, 0.0)),
        (folder / "test", "test", _cameras(test, width, 0.5)),
    ):
        frames = renderer.render_views(resident, cameras, outputs="rgb", quality="standard,samples=3")
        for _ in write_views(out, stem, cameras, (frame["rgb"] for frame in frames), *_points(scene, seed)):
            done += 1
            if progress is not None:
                progress("images", done / (views + test))
    # written last, since it marks a complete data set
    write_json(folder / "dataset.json", {"background": scene.background, "seed": seed})
    return folder


def write_views(
    folder: Path,
    stem: str,
    cameras: Sequence[Camera],
    images: Iterable[np.ndarray],
    points: np.ndarray,
    colors: np.ndarray,
) -> Iterator[Path]:
    """Write images and their COLMAP model for training; yields the file of each image.

    points: (n, 3) metres, with colors (n, 3) uint8.
    """
    names = [f"{stem}-{i:02d}.png" for i in range(len(cameras))]
    writable_folder(folder / "images")
    for name, image in zip(names, images, strict=True):
        yield write_png(folder / "images" / name, image)
    save_colmap(folder / "sparse" / "0", names, cameras, points, colors)


def _cameras(count: int, width: int, shift: float) -> list[Camera]:
    """Cameras on an arc with varying distances and heights.

    shift: 0.5 shifts the cameras by half of their spacing.
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
