"""Table 4: novel views. Pictures from 20 random viewpoints against ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.blender import VIEW_NAMES, novel_picture
from fidsplat.experiments.methods import (
    IDEAL,
    Draw,
    Painter,
    in_linear_light,
    plain_marker,
    with_linear_light,
)
from fidsplat.experiments.plane import from_srgb, plane_picture, srgb
from fidsplat.experiments.setup import BACKGROUND, CATEGORIES, PROTOCOLS, TEST_VIEWS, Category, novel_cameras
from fidsplat.images.files import read_image, to_uint8
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.vision.metrics import flip, has_flip, psnr, ssim

NAME = "views"
TRUTHS = {
    "exact": "exact renderer, means of display values",
    "exact-linear": "exact renderer, means of linear light, then the sRGB curve",
    "blender-standard": "Blender, view 'Standard'",
    "blender-raw": "Blender, view 'Raw' on display values",
}
LINEAR = ("exact-linear", "blender-standard")
"""those that take means of linear light: drawing in linear light is compared with these alone"""
Perceptual = Callable[[np.ndarray, np.ndarray], float]


def views_points(
    categories: Iterable[Category],
    methods: Iterable[str],
    blender: Path,
    markers: int = 5,
    views: int = TEST_VIEWS,
    lpips: str | None = None,
) -> list[dict]:
    """The points of the experiment: one marker by one method against one ground truth.

    Args:
        blender: folder of `fidsplat experiment blender`; its pictures take part where a marker has all of
            them.
        views: how many of the 20.
        lpips: what distinguishes the weights of LPIPS, when it is measured.
    """
    points = []
    for category in categories:
        for index in range(markers):
            truths = ["exact", "exact-linear"]
            truths += [
                f"blender-{view}"
                for view in VIEW_NAMES
                if all(novel_picture(blender, view, category.name, index, i).is_file() for i in range(views))
            ]
            for method in with_linear_light(methods):
                for truth in truths:
                    point = {
                        "category": category.name,
                        "index": index,
                        "method": method,
                        "truth": truth,
                        "views": views,
                        "flip": has_flip(),
                        "lpips": lpips,
                    }
                    equal = method == IDEAL and truth == "exact"  # by definition
                    if not equal and (truth in LINEAR or not in_linear_light(method)):
                        points.append(point)
    return points


class Kept:
    """8-bit pictures that the points after this one need again."""

    def __init__(self) -> None:
        self._about: dict[str, tuple] = {}
        self._pictures: dict[str, dict[int, np.ndarray]] = {}
        self._lock = Lock()  # truths are made by the threads that look at pictures

    def get(self, kind: str, about: tuple, number: int, make: Callable[[], np.ndarray]) -> np.ndarray:
        """Picture `number` of what `about` names, made if it is not there; of each kind one thing is kept."""
        with self._lock:
            if self._about.get(kind) != about:
                self._about[kind], self._pictures[kind] = about, {}
            there = self._pictures[kind]
        picture = there.get(number)
        if picture is None:
            picture = there[number] = to_uint8(make())
        return picture


def measure_views(
    point: dict,
    painter: Painter,
    seed: int,
    blender: Path,
    pool: ThreadPoolExecutor,
    lpips: Perceptual | None = None,
    kept: Kept | None = None,
) -> dict:
    """Compare one marker's pictures, in 8 bits, with the truth.

    Args:
        kept: the same for all points of a run: a method's pictures are drawn once for all truths, which
            follow one another, and a marker's exact truths once for all methods.

    Returns `psnr` (dB), `ssim`, `flip` and `lpips`: a number for each view; None for a metric that cannot be
    measured here, and for the PSNR of equal pictures.
    """
    category = CATEGORIES[point["category"]]
    spec = category.spec(point["index"], seed)
    module = PROTOCOLS["fixed-plane"].module(plain_marker(spec).grid.shape[0])
    kept = kept or Kept()
    marker = (point["category"], point["index"], seed)
    opened: list[Draw] = []

    def draw(camera: Camera) -> np.ndarray:
        if not opened:
            name = f"{category.name}-{point['index']}"
            opened.append(painter.open(point["method"], name, spec, module))
        return opened[0](camera)

    def true(number: int, camera: Camera) -> np.ndarray:
        kind = point["truth"]
        if kind.startswith("exact"):
            return kept.get(kind, marker, number, lambda: exact_view(spec, camera, kind == "exact-linear"))
        view = kind.removeprefix("blender-")
        return read_image(novel_picture(blender, view, category.name, point["index"], number))[:, :, 0]

    def compare(number: int, camera: Camera, picture: np.ndarray) -> dict[str, float | None]:
        truth = true(number, camera)
        if truth.shape != picture.shape:
            raise InputError(f"the Blender pictures in {blender} have another size; render them again")
        ours, theirs = picture / 255.0, to_uint8(truth) / 255.0
        ratio = psnr(ours, theirs)
        found = {"psnr": None if np.isinf(ratio) else ratio, "ssim": ssim(ours, theirs)}
        if point["flip"]:
            found["flip"] = flip(ours, theirs)
        if lpips is not None:
            found["lpips"] = lpips(ours, theirs)
        return found

    cameras = novel_cameras(category, point["index"], seed)[: point["views"]]
    about = (*marker, point["method"])
    waiting = [
        pool.submit(compare, i, camera, kept.get("drawn", about, i, partial(draw, camera)))
        for i, camera in enumerate(cameras)
    ]
    measured = [interrupts.result_of(future) for future in waiting]
    names = ("psnr", "ssim", "flip", "lpips")
    return {name: [one[name] for one in measured] if name in measured[0] else None for name in names}


def exact_view(spec: str, camera: Camera, linear: bool) -> np.ndarray:
    """The ground truth of one view, (h, w) display values.

    linear: a pixel's mean is taken of linear light and then encoded, as Blender's 'Standard' view does it.
    """
    grid = plain_marker(spec).grid
    module = PROTOCOLS["fixed-plane"].module(grid.shape[0])
    if not linear:
        return plane_picture(grid, module, camera, background=BACKGROUND)
    return srgb(plane_picture(grid, module, camera, background=from_srgb(BACKGROUND)))
