"""Write the data set of the paper's section 4.1: 25 markers x 4 viewpoint collections, 100 scenes for COLMAP.

    python benchmarks/paper_dataset.py -o DATASET [--truth blender-standard --blender DIR] [--seed 0]

Existing scenes are unchanged. About 300 MB.

SCENE/images/view-00.png ...      training images
SCENE/sparse/0/cameras.bin ...    their model, .bin and .txt
SCENE/test/images/test-00.png ... 20 random views, the same for the four collections of a marker
SCENE/test/sparse/0/...
SCENE/marker.json                 spec, sizes, corners
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.blender import TEST, TRAINING, check_images, image_file
from fidsplat.experiments.demo_views import write_views
from fidsplat.experiments.setup import (
    BACKGROUND,
    CATEGORIES,
    COLLECTIONS,
    PLANE,
    PROTOCOLS,
    SEED,
    Category,
    novel_cameras,
    training_cameras,
)
from fidsplat.experiments.views import TRUTHS, exact_view
from fidsplat.images.files import read_image
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
    points = _points(spec, f"{seed} points {category.name} {index}")

    def image(kind: str, i: int, camera: Camera) -> np.ndarray:
        if not truth.startswith("blender-"):
            return np.repeat(exact_view(spec, camera, truth == "exact-linear")[:, :, None], 3, axis=2)
        source = image_file(blender, truth.removeprefix("blender-"), category.name, index, kind, i)
        if not source.is_file():
            raise InputError(f"{source} is missing; run fidsplat experiment blender --training first")
        return read_image(source)

    for part, kind, cameras in (
        (folder, TRAINING, training_cameras(scene["views"])),
        (folder / "test", TEST, novel_cameras(category, index, seed)),
    ):
        images = (image(kind, i, camera) for i, camera in enumerate(cameras))
        list(write_views(part, kind, cameras, images, *points))
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


def write_dataset(
    out: Path,
    truth: str,
    blender: Path,
    seed: int = SEED,
    categories: Iterable[Category] = CATEGORIES.values(),
) -> None:
    """Write all scenes of the data set. Raises InputError for Blender's images of another seed."""
    if truth.startswith("blender-"):
        check_images(blender, truth.removeprefix("blender-"), seed)
    for scene in dataset_scenes(categories):
        print(write_scene(scene, writable_folder(out), seed, truth, blender))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("-o", "--out", type=Path, default=Path("fidsplat-dataset"))
    parser.add_argument("--truth", choices=TRUTHS, default="exact", help="renderer of the images")
    parser.add_argument("--blender", type=Path, default=Path("fidsplat-experiments/blender"))
    parser.add_argument("--seed", type=int, default=SEED)
    words = parser.parse_args()
    write_dataset(words.out, words.truth, words.blender, words.seed)
