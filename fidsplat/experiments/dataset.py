"""The data set of the paper's section 4.1: 25 markers x 4 viewpoint collections, 100 scenes for COLMAP.

SCENE/images/view-00.png ...      training images
SCENE/sparse/0/cameras.bin ...    their model, .bin and .txt
SCENE/test/images/test-00.png ... 20 random views, the same for the four collections of a marker
SCENE/test/sparse/0/...
SCENE/marker.json                 spec, sizes, corners
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fidsplat.experiments.blender import TEST, TRAINING, image_file
from fidsplat.experiments.setup import (
    BACKGROUND,
    CATEGORIES,
    COLLECTIONS,
    PLANE,
    PROTOCOLS,
    Category,
    novel_cameras,
    training_cameras,
)
from fidsplat.experiments.views import exact_view
from fidsplat.formats.colmap import save_colmap
from fidsplat.images.files import read_image, write_png
from fidsplat.markers import marker
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_text, writable_folder, write_json

POINTS = 1000
"""initial 3D points for trainers: random points on the plane with its colours"""


def dataset_scenes(categories: Iterable[Category], markers: int = 5) -> list[dict]:
    """Scenes of the data set."""
    return [
        {"category": c.name, "index": i, "views": n}
        for c in categories
        for i in range(markers)
        for n in COLLECTIONS
    ]


def scene_name(scene: dict) -> str:
    """Name of a scene, e.g. "small-0-views-17"."""
    return f"{scene['category']}-{scene['index']}-views-{scene['views']}"


def write_scene(scene: dict, out: Path, seed: int, truth: str, blender: Path) -> Path:
    """Write a scene unless it is complete; marker.json is written last. Returns its folder.

    Args:
        scene: scene of `dataset_scenes`.
        out: folder of the data set.
        truth: renderer of its images, one of `fidsplat.experiments.views.TRUTHS`.
        blender: folder of Blender's images, for ground truth from Blender.

    Raises InputError if an image of Blender is missing or the folder cannot be written.
    """
    folder, index = out / scene_name(scene), scene["index"]
    category = CATEGORIES[scene["category"]]
    spec = category.spec(index, seed)
    facts = _facts(spec, scene["views"], seed, truth)
    file = folder / "marker.json"
    if _is_complete(file, facts):
        return folder
    # an interrupted run must not mix two kinds of images
    file.unlink(missing_ok=True)
    points, colors = _points(spec, f"{seed} points {category.name} {index}")
    for place, kind, cameras in (
        (folder, TRAINING, training_cameras(scene["views"])),
        (folder / "test", TEST, novel_cameras(category, index, seed)),
    ):
        writable_folder(place / "images")
        names = [f"{kind}-{i:02d}.png" for i in range(len(cameras))]
        for i, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            if truth.startswith("blender-"):
                view = truth.removeprefix("blender-")
                source = image_file(blender, view, category.name, index, kind, i)
                if not source.is_file():
                    raise InputError(f"{source} is missing; run fidsplat experiment blender --training first")
                image = read_image(source)
            else:
                image = np.repeat(exact_view(spec, camera, truth == "exact-linear")[:, :, None], 3, axis=2)
            write_png(place / "images" / name, image)
        save_colmap(place / "sparse" / "0", names, cameras, points, colors)
    write_json(file, facts, indent=1)
    return folder


def _is_complete(file: Path, facts: dict) -> bool:
    try:
        return from_json(read_text(file)) == facts
    except ValueError:  # or InputError if it is missing
        return False


def _facts(spec: str, views: int, seed: int, truth: str) -> dict:
    plain = marker(spec)
    module = PROTOCOLS["fixed-plane"].module(plain.grid.shape[0])
    return {
        "spec": spec,
        "views": views,
        "seed": seed,
        "truth": truth,
        "plane_m": PLANE,
        "module_m": module,
        "quiet_zone_modules": plain.quiet_zone,
        "background": BACKGROUND,
        "corners_m": (plain.corners / plain.module * module).tolist(),
    }


def _points(spec: str, seed: str) -> tuple[np.ndarray, np.ndarray]:
    grid = marker(spec).grid
    generator = np.random.default_rng(zlib.crc32(seed.encode()))
    uv = generator.uniform(0, 1, (POINTS, 2))
    column, row = (uv * grid.shape[::-1]).astype(int).T
    points = np.column_stack([(uv - 0.5) * PLANE, np.zeros(POINTS)])
    return points, np.repeat(255 * (1 - grid[row, column])[:, None], 3, axis=1).astype(np.uint8)
