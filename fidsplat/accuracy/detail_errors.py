"""Errors of levels of detail of a store (chunks on disk): frames with merged cells and exact frames."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from datetime import date
from typing import Any

import numpy as np

from fidsplat.accuracy.error import REFERENCE_CUTOFF
from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.render.renderer import Renderer
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.detail_errors import DetailErrors, DetailSettings, load_detail_errors, save_detail_errors
from fidsplat.store.store import Store
from fidsplat.streaming.level_of_detail import select
from fidsplat.util.arguments import settings_with
from fidsplat.util.errors import InputError
from fidsplat.util.progress import Progress, no_progress

SIZES = tuple(2.0 ** (k / 2) for k in range(-8, 3))
"""measured cell sizes in samples, 1/16 to 2"""
WIDTH, HEIGHT, FOV_X = 320, 180, math.radians(60.0)


def measure_detail(
    store: Store,
    renderer: Renderer,
    settings: DetailSettings | None = None,
    progress: Progress = no_progress,
    **changes: Any,
) -> list[DetailErrors]:
    """Measure errors by cell size from random poses around and inside a store, and save them in its folder.

    `Quality.detail_error` selects levels of detail by these errors.

    Args:
        settings: None: `DetailSettings()`. `changes` are settings by name: views, lowpass, seed.
        progress: called with the current step and its completed fraction, 0 to 1.

    Raises:
        InputError: the store has instances, no splats or no levels of detail, or an option is invalid.
    """
    settings = settings_with(DetailSettings, settings, changes)
    if store.poses is not None:
        raise InputError(
            f"store must contain splats, got {store.path}, which contains instances of another store; pass "
            f"{store.header.store}"
        )
    if not len(store) or not store.nodes["level"].any():
        raise InputError(
            f"{store.path} must have levels of detail, got none; build it again with levels, from more splats"
        )
    measured, levels, views = [], range(1, store.levels + 1), settings.views
    for number, lowpass in enumerate(settings.lowpass):
        max_errors: dict[int, list[float | None]] = {level: [None] * len(SIZES) for level in levels}
        for view, camera in enumerate(cameras_around(store, views, settings.seed)):
            level = levels[view % len(levels)]
            # a larger cut-off would omit more of the small splats than of the merged splats
            capture = Capture(camera, quality=Quality(lowpass=lowpass, alpha_cutoff=REFERENCE_CUTOFF))
            errors = errors_of(store, renderer, capture, SIZES, level)
            max_errors[level] = [_larger(*pair) for pair in zip(max_errors[level], errors, strict=True)]
            progress("measuring levels of detail", (number + (view + 1) / views) / len(settings.lowpass))
        provenance = -(-views // len(levels)), renderer.device.title, date.today().isoformat()
        measured += [
            DetailErrors(lowpass, level, SIZES, tuple(errors), *provenance)
            for level, errors in max_errors.items()
        ]
    save_detail_errors(store.path, store.identity, measured)
    store.detail_errors = load_detail_errors(store.path, store.identity)
    return measured


def _larger(a: float | None, b: float | None) -> float | None:
    return max((error for error in (a, b) if error is not None), default=None)


def errors_of(
    store: Store, renderer: Renderer, capture: Capture, sizes: Sequence[float], level: int
) -> list[float | None]:
    """Largest difference of rgb from the exact frame for each size; cells of a smaller projected size are
    merged. None for a size that merges the same cells as the next smaller size, or that changes no pixel.

    Args:
        sizes: ascending, in samples.
        level: the coarsest level of detail that may be used.
    """
    splats = ChunkedSplats([store])
    features, view = prepare(splats, capture)
    complete = previous = select(splats, [view], features)
    exact = None
    max_errors: list[float | None] = [None] * len(sizes)
    for number, size in enumerate(sizes):
        level_sizes = tuple(size if 0 < k <= level else 0.0 for k in range(store.levels + 1))
        selection = select(splats, [view], features, (level_sizes,))
        if selection == previous:
            continue
        if exact is None:
            exact = renderer.render(splats.load(complete), capture)["rgb"].astype(np.float64)
        merged = renderer.render(splats.load(selection), capture)["rgb"]
        # no change of a pixel gives None, not an error of 0
        max_errors[number], previous = float(np.abs(merged - exact).max()) or None, selection
    return max_errors


def cameras_around(store: Store, count: int, seed: int = 0) -> Iterator[Camera]:
    """Cameras that look at random chunks, for one level after another, at random distances where cells of
    the level have a projected size within `SIZES`."""
    generator = np.random.default_rng(seed)
    nodes = store.nodes
    chunks = nodes[nodes["level"] == 0]
    levels = range(1, int(nodes["level"].max()) + 1)
    edges = [float(np.median(nodes["size"][nodes["level"] == level])) for level in levels]
    rounds = -(-count // len(edges))
    focal = WIDTH / 2 / math.tan(FOV_X / 2)
    for number in range(count):
        chunk = chunks[generator.integers(len(chunks))]
        target = (chunk["low"] + chunk["high"]).astype(np.float64) / 2 + store.origin
        # stratified sampling of the logarithm of the size
        fraction = (number // len(edges) + generator.random()) / rounds
        size = SIZES[0] * (SIZES[-1] / SIZES[0]) ** fraction
        distance = edges[number % len(edges)] * focal / size
        direction = generator.normal(size=3)
        position = target + distance * direction / np.linalg.norm(direction)
        near = min(0.01, distance / 100)
        yield Camera.look_at(WIDTH, HEIGHT, FOV_X, position, target, up=(0.0, -1.0, 1e-3), near=near)
