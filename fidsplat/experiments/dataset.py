"""The data set of the paper's section 4.1: 25 markers x 4 viewpoint collections, 100 scenes for COLMAP.

SCENE/images/view-00.png ...      training views
SCENE/sparse/0/cameras.bin ...    their model, .bin and .txt
SCENE/test/images/test-00.png ... 20 random views, the same for the four collections of a marker
SCENE/test/sparse/0/...
SCENE/marker.json                 spec, sizes, corners
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fidsplat.experiments.blender import novel_image, training_image
from fidsplat.experiments.methods import plain_marker
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
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, read_text, writable_folder

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


def scene_name(wanted: dict) -> str:
    """Name of a scene, e.g. "small-0-views-17"."""
    return f"{wanted['category']}-{wanted['index']}-views-{wanted['views']}"


def write_scene(wanted: dict, folder: Path, seed: int, truth: str, blender: Path) -> Path:
    """Write a scene unless it is complete; marker.json is written last.

    Args:
        wanted: scene of `dataset_scenes`.
        truth: source of its images, one of `fidsplat.experiments.views.TRUTHS`.
        blender: folder of Blender's images, for ground truth from Blender.

    Raises InputError if an image of Blender is missing or the folder cannot be written.
    """
    scene = folder / scene_name(wanted)
    category = CATEGORIES[wanted["category"]]
    spec = category.spec(wanted["index"], seed)
    about = _about(spec, wanted, seed, truth)
    note = scene / "marker.json"
    if _whole(note, about):
        return scene
    # an interrupted run must not mix two kinds of images
    note.unlink(missing_ok=True)
    points, colors = _points(spec, f"{seed} points {category.name} {wanted['index']}")
    sets = (
        (scene, "view", training_cameras(wanted["views"]), training_image),
        (scene / "test", "test", novel_cameras(category, wanted["index"], seed), novel_image),
    )
    for place, stem, cameras, drawn in sets:
        writable_folder(place / "images")
        names = [f"{stem}-{i:02d}.png" for i in range(len(cameras))]
        for i, (name, camera) in enumerate(zip(names, cameras, strict=True)):
            if truth.startswith("blender-"):
                file = drawn(blender, truth.removeprefix("blender-"), category.name, wanted["index"], i)
                if not file.is_file():
                    raise InputError(f"{file} is missing; run fidsplat experiment blender --training first")
                picture = read_image(file)
            else:
                picture = _rgb(exact_view(spec, camera, truth == "exact-linear"))
            write_png(place / "images" / name, picture)
        save_colmap(place / "sparse" / "0", names, cameras, points, colors)
    with atomic_write(note) as stream:
        stream.write(json.dumps(about, indent=1).encode())
    return scene


def _whole(note: Path, about: dict) -> bool:
    try:
        return from_json(read_text(note)) == about
    except ValueError:  # InputError too: it is not there
        return False


def _about(spec: str, wanted: dict, seed: int, truth: str) -> dict:
    plain = plain_marker(spec)
    module = PROTOCOLS["fixed-plane"].module(plain.grid.shape[0])
    return {
        "spec": spec,
        "views": wanted["views"],
        "seed": seed,
        "truth": truth,
        "plane_m": PLANE,
        "module_m": module,
        "quiet_zone_modules": plain.quiet_zone,
        "background": BACKGROUND,
        "corners_m": (plain.corners / plain.module * module).tolist(),
    }


def _points(spec: str, seed: str) -> tuple[np.ndarray, np.ndarray]:
    grid = plain_marker(spec).grid
    generator = np.random.default_rng(zlib.crc32(seed.encode()))
    places = generator.uniform(0, 1, (POINTS, 2))
    column, row = (places * grid.shape[::-1]).astype(int).T
    points = np.column_stack([(places - 0.5) * PLANE, np.zeros(POINTS)])
    return points, np.repeat(255 * (1 - grid[row, column])[:, None], 3, axis=1).astype(np.uint8)


def _rgb(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[:, :, None], 3, axis=2)
