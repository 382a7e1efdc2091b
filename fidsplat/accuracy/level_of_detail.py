"""Measuring what levels of detail cost: pictures of a store with its cells merged up to a size, against the
exact ones, from many places."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from datetime import date

import numpy as np

from fidsplat.accuracy.error import TRUTH_CUTOFF
from fidsplat.backends.prepare import prepare
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import LOWPASS, Quality
from fidsplat.render.renderer import Renderer
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.detail import Detail, load_details, save_details
from fidsplat.store.store import Store
from fidsplat.streaming.level_of_detail import select
from fidsplat.util.errors import InputError

SIZES = tuple(2.0 ** (k / 2) for k in range(-8, 3))
"""samples: 1/16 to 2"""
WIDTH, HEIGHT, FOV_X = 320, 180, math.radians(60.0)


def measure_detail(
    store: Store,
    renderer: Renderer,
    views: int = 60,
    lowpass: Sequence[str] = ("pixel",),
    seed: int = 0,
    progress: Callable[[str, float], object] = lambda words, share: None,
) -> list[Detail]:
    """Measure errors by sizes with pictures from random places around and inside a store, and keep them
    beside it, for `Quality.detail_error`.

    Args:
        views: places, by turns for each level. lowpass: those of `Quality.lowpass` to measure.
        seed: of the places.
        progress: called with what is being done and the share of it that is done, 0 to 1.

    Raises:
        InputError: a store of places (measure what is placed), one without levels of detail or without
            splats, or numbers that cannot be used.
    """
    if store.poses is not None:
        raise InputError(
            f"{store.path} is a store of places; measure {store.header.store}, which stands there"
        )
    if not len(store) or not store.nodes["level"].any():
        raise InputError(f"{store.path} has no levels of detail; build it with them, and of more splats")
    if isinstance(views, bool) or not isinstance(views, int) or not 1 <= views <= 10_000:
        raise InputError(f"views is {views!r}; it must be a whole number from 1 to 10,000")
    if unknown := set(lowpass) - set(LOWPASS):
        raise InputError(f"lowpass is {min(unknown)!r}; known: {', '.join(LOWPASS)}")
    made, levels = [], range(1, store.levels + 1)
    for number, one in enumerate(lowpass):
        worst: dict[int, list[float | None]] = {level: [None] * len(SIZES) for level in levels}
        for done, camera in enumerate(cameras_around(store, views, seed)):
            level = levels[done % len(levels)]
            # a cut-off leaves out more of small splats than of those that stand for them
            capture = Capture(camera, quality=Quality(lowpass=one, alpha_cutoff=TRUTH_CUTOFF))
            found = errors_of(store, renderer, capture, SIZES, level)
            worst[level] = [_larger(*pair) for pair in zip(worst[level], found, strict=True)]
            progress("measuring levels of detail", (number + (done + 1) / views) / len(lowpass))
        about = -(-views // len(levels)), renderer.device.title, date.today().isoformat()
        made += [Detail(one, level, SIZES, tuple(errors), *about) for level, errors in worst.items()]
    save_details(store.path, store.identity, made)
    store.details = load_details(store.path, store.identity)
    return made


def _larger(one: float | None, other: float | None) -> float | None:
    return max((error for error in (one, other) if error is not None), default=None)


def errors_of(
    store: Store, renderer: Renderer, capture: Capture, sizes: Sequence[float], level: int
) -> list[float | None]:
    """The largest difference of rgb from the exact picture for each size [samples], rising, with nodes up to
    a level; None where no cells are merged that smaller sizes would leave apart, or none that shows."""
    splats = ChunkedSplats([store])
    features, view = prepare(splats, capture)
    before, exact = select(splats, [view], features), None
    whole = before
    worst: list[float | None] = [None] * len(sizes)
    for number, size in enumerate(sizes):
        limits = tuple(size if 0 < at <= level else 0.0 for at in range(store.levels + 1))
        selection = select(splats, [view], features, (limits,))
        if selection == before:
            continue
        if exact is None:
            exact = renderer.render(splats.part(whole), capture)["rgb"].astype(np.float64)
        picture = renderer.render(splats.part(selection), capture)["rgb"]
        # what is merged where nobody sees it says nothing about this size
        worst[number], before = float(np.abs(picture - exact).max()) or None, selection
    return worst


def cameras_around(store: Store, count: int, seed: int = 0) -> Iterator[Camera]:
    """Cameras that look at random chunks, from where the cells of each level in turn are of all sizes of
    `SIZES` on the picture."""
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
        # spread over the sizes, so that each is met
        share = (number // len(edges) + generator.random()) / rounds
        size = SIZES[0] * (SIZES[-1] / SIZES[0]) ** share
        away = edges[number % len(edges)] * focal / size
        towards = generator.normal(size=3)
        position = target + away * towards / np.linalg.norm(towards)
        near = min(0.01, away / 100)
        yield Camera.look_at(WIDTH, HEIGHT, FOV_X, position, target, up=(0.0, -1.0, 1e-3), near=near)
