"""Table 4, novel views: images from 20 random viewpoints against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Executor
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.blender import TEST, VIEW_NAMES, image_file
from fidsplat.experiments.methods import (
    IDEAL,
    MarkerRenderer,
    in_linear_light,
    with_linear_light,
)
from fidsplat.experiments.plane import plane_image
from fidsplat.experiments.setup import (
    BACKGROUND,
    BACKGROUND_LIGHT,
    CATEGORIES,
    PROTOCOLS,
    TEST_VIEWS,
    Category,
    novel_cameras,
)
from fidsplat.images.files import read_image, to_uint8
from fidsplat.markers import marker
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.response import to_colors
from fidsplat.vision.metrics import flip, has_flip, psnr, ssim

NAME = "views"
TRUTHS = {
    "exact": "exact renderer, means of display values",
    "exact-linear": "exact renderer, means of linear light, then the sRGB curve",
    "blender-standard": "Blender, view 'Standard'",
    "blender-raw": "Blender, view 'Raw' on display values",
}
LINEAR = ("exact-linear", "blender-standard")
"""ground truths that average linear light, with which methods in linear light are compared"""
Perceptual = Callable[[np.ndarray, np.ndarray], float]


def views_points(
    categories: Iterable[Category],
    methods: Iterable[str],
    blender: Path,
    markers: int = 5,
    views: int = TEST_VIEWS,
    lpips: bool = False,
) -> list[dict]:
    """Points of the experiment: combinations of marker, method and ground truth.

    Args:
        blender: folder of `fidsplat experiment blender`; used for markers with all images.
        views: number of views, at most 20.
        lpips: whether LPIPS is measured.
    """
    points = []
    for category, index in product(categories, range(markers)):
        truths = ["exact", "exact-linear"]
        for view in VIEW_NAMES:
            files = (image_file(blender, view, category.name, index, TEST, i) for i in range(views))
            if all(file.is_file() for file in files):
                truths.append(f"blender-{view}")
        common = {"category": category.name, "index": index}
        metrics = {"views": views, "flip": has_flip(), "lpips": lpips or None}
        points += [
            {**common, "method": method, "truth": truth, **metrics}
            for method, truth in product(with_linear_light(methods), truths)
            # skip pairs that are equal by definition, or that average different light
            if (method, truth) != (IDEAL, "exact") and (truth in LINEAR or not in_linear_light(method))
        ]
    return points


@lru_cache(1)  # consecutive points have the same method
def _images_of(
    markers: MarkerRenderer, method: str, category: str, index: int, seed: int, count: int
) -> list[np.ndarray]:
    """8-bit images (h, w) of the first views of a marker by a method."""
    spec = CATEGORIES[category].spec(index, seed)
    module = PROTOCOLS["fixed-plane"].module(marker(spec).grid.shape[0])
    render = markers.prepare(method, f"{category}-{index}", spec, module)
    return [to_uint8(render(camera)) for camera in novel_cameras(CATEGORIES[category], index, seed)[:count]]


@lru_cache(2 * TEST_VIEWS)  # the exact images of a marker are shared by all methods
def _exact_image(category: str, index: int, seed: int, number: int, linear: bool) -> np.ndarray:
    camera = novel_cameras(CATEGORIES[category], index, seed)[number]
    return to_uint8(exact_view(CATEGORIES[category].spec(index, seed), camera, linear))


def measure_views(
    point: dict,
    markers: MarkerRenderer,
    seed: int,
    blender: Path,
    pool: Executor,
    lpips: Perceptual | None = None,
) -> dict:
    """Compare the 8-bit images of a marker with the ground truth.

    Returns `psnr` (dB), `ssim`, `flip` and `lpips` with a number per view; None for an unavailable metric,
    and for the PSNR of equal images.
    """
    category, index, truth = point["category"], point["index"], point["truth"]

    def compare(number: int, image: np.ndarray) -> dict[str, float | None]:
        if truth.startswith("exact"):
            reference = _exact_image(category, index, seed, number, truth == "exact-linear")
        else:
            view = truth.removeprefix("blender-")
            file = image_file(blender, view, category, index, TEST, number)
            reference = to_uint8(read_image(file)[:, :, 0])
        if reference.shape != image.shape:
            raise InputError(
                f"images in {blender} must have the shape {image.shape}, got {reference.shape}; render again"
            )
        ours, theirs = image / 255.0, reference / 255.0
        ratio = psnr(ours, theirs)
        metrics = {"psnr": None if np.isinf(ratio) else ratio, "ssim": ssim(ours, theirs)}
        if point["flip"]:
            metrics["flip"] = flip(ours, theirs)
        if lpips is not None:
            metrics["lpips"] = lpips(ours, theirs)
        return metrics

    images = _images_of(markers, point["method"], category, index, seed, point["views"])
    pending = [pool.submit(compare, number, image) for number, image in enumerate(images)]
    measured = [interrupts.result_of(future) for future in pending]
    names = ("psnr", "ssim", "flip", "lpips")
    return {name: [values[name] for values in measured] if name in measured[0] else None for name in names}


def exact_view(spec: str, camera: Camera, linear: bool) -> np.ndarray:
    """Ground truth of a view, (h, w) display values.

    linear: average linear light and encode the mean, as Blender's view transform 'Standard' does.
    """
    grid = marker(spec).grid
    module = PROTOCOLS["fixed-plane"].module(grid.shape[0])
    if not linear:
        return plane_image(grid, module, camera, background=BACKGROUND)
    light = plane_image(grid, module, camera, background=BACKGROUND_LIGHT)
    return to_colors(np.clip(light, 0.0, 1.0), "srgb")
