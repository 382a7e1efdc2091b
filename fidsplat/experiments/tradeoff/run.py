"""Sweep of the trade-off of time and error: its points, most informative first, and their measurement."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from fidsplat.experiments.run import device_name
from fidsplat.experiments.sweep import Key, Results, Sweep, TimeLimit, Work, thread_pool
from fidsplat.experiments.tradeoff import points, scenes
from fidsplat.experiments.tradeoff.points import ABLATION, BASE, MARKER, PRESET, Point
from fidsplat.experiments.tradeoff.session import FULL, QUICK, Effort, Session, compare_image, time_point
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.provenance import run_facts
from fidsplat.util.timing import frame_timer
from fidsplat.vision.readers import reader_versions

NAME = "tradeoff"
FILE = f"{NAME}.jsonl"
_EARLY = ("base", PRESET, ABLATION, "alpha_cutoff", "transmittance_stop", MARKER)
QUICK_SECONDS = 150.0
"""time limit of a --quick measurement, so that loading and the last batch end within the promised 3
minutes"""
QUICK_VIEWS = 2
"""maximum number of views of a user's scene with --quick"""
OVERHEAD = 0.7
"""estimated seconds per point for compilation and evaluation"""
_BATCH = 16
"""maximum number of images that wait for evaluation"""


@dataclass(frozen=True)
class TradeoffSettings:
    """Scenes, quality settings and length of a trade-off measurement."""

    scenes: tuple[str, ...] | None = None
    """Scenes to measure. By default all, with --quick four."""
    settings: Annotated[tuple[str, ...] | None, "--knobs"] = None
    """NAME...: quality settings to vary: names of Quality's fields, or preset, alone, marker, together
    (default: all)"""
    quick: bool = False
    """Measure few values and frames, four scenes or two of your views, for at most 3 minutes per device; the
    same command continues."""
    overwrite: bool = False
    """Replace existing results."""
    workers: int = min(_BATCH, os.cpu_count() or 1)
    """Number of threads that evaluate images while nothing is timed."""


@contextmanager
def prepared(
    options: TradeoffSettings, out: Path, device: str, user_views: scenes.Views | None = None
) -> Iterator[Sweep]:
    """Sweep with its renderer and results. A view that the device cannot render has a result with `error`.

    Raises InputError for invalid options, DeviceError if the device cannot be opened.
    """
    user_views, quick = user_views or {}, options.quick
    keys = (
        user_points(user_views, options.settings or (), quick)
        if user_views
        else all_points(options.scenes or (), options.settings or (), quick)
    )
    renderer = Renderer(device)
    info = renderer.device
    if info.always_float64:
        raise InputError(f"--device must be another device than reference, got {info.name}; leave it out")
    versions = reader_versions() | {"pyopencl": version("pyopencl")}
    facts = run_facts(device_name(renderer), scenes.SEED, versions)
    facts |= {"kind": info.kind, "title": info.title} | (
        {"scene": scenes.digests(user_views)} if user_views else {}
    )
    results = Results(out / FILE, facts, options.overwrite)
    session = Session(renderer, user_views)
    with thread_pool(options.workers) as pool:
        yield Sweep(
            f"{NAME} on {device}",
            results,
            keys,
            lambda key: _begin(session, key, quick),
            options.workers,
            pool,
            record_errors=True,
            limit=TimeLimit(QUICK_SECONDS) if quick else None,
            estimate=lambda: estimated_seconds(session, results.left(keys), QUICK if quick else FULL),
        )


def estimated_seconds(session: Session, keys: list[Key], effort: Effort) -> float:
    """Estimated seconds of points, from one frame of the baseline per scene."""
    frames: dict[str, float] = {}
    total = 0.0
    for key in keys:
        name = key["scene"].partition("@")[0]
        if name not in frames:
            frames[name] = _frame_ms(session, key["scene"])
        frame = 1e-3 * frames[name]
        samples = key["quality"].get("samples", 1) ** 2
        rounds = min(max(effort.minimum, effort.seconds / max(frame * (1 + samples), 1e-6)), effort.maximum)
        # frames of the setting: the image, its memory, warm-up and rounds; of the baseline: warm-up and
        # rounds
        total += OVERHEAD + frame * ((rounds + 3) * samples + rounds + 1)
    return total


def _frame_ms(session: Session, view: str) -> float:
    """Milliseconds of the second frame of the baseline; 0 if the device cannot render it."""
    try:
        session.render(view, BASE).wait()  # compiles
        resident, scene = session.resident(view, BASE.marker), session.scene(view, BASE.marker)
        return frame_timer(session.renderer, resident, scene.capture, quality=BASE).run()
    except FidsplatError:  # the results of the points report it
        return 0.0


def all_points(names: tuple[str, ...], settings: tuple[str, ...], quick: bool) -> list[Key]:
    """Points of a run on standard scenes.

    Raises:
        InputError: an unknown scene or setting.
    """
    settings = points.setting_names(settings)
    ordered: list[tuple[int, Key]] = []
    for name in scenes.scene_names(names, quick):
        on_marker = scenes.is_marker(name)
        every_value = name not in scenes.FEW_SETTINGS and not (on_marker and quick)
        varied = points.points(settings, on_marker, quick, every_value)
        if name in scenes.GAUSSIANS_3D:
            varied = points.ellipsoid_points(settings)
        if name == "r1m_1080p":  # 18 million samples take minutes on a CPU; the smaller scene suffices
            varied = [point for point in varied if point.quality.samples <= 2]
        for view in scenes.views_of(name):
            ordered += _view_points(view, varied, quick)
    return _by_priority(ordered)


def user_points(views: Iterable[str], settings: tuple[str, ...], quick: bool) -> list[Key]:
    """Points of the user's views, by view name.

    Raises:
        InputError: an unknown setting.
    """
    varied = points.points(points.setting_names(settings), on_marker=False, quick=quick)
    return _by_priority([pair for view in views for pair in _view_points(view, varied, quick)])


def _view_points(view: str, varied: Iterable[Point], quick: bool) -> list[tuple[int, Key]]:
    """Points of a view, with priorities."""
    return [
        (0 if point.setting in _EARLY else 2, {"scene": view, **point.key(), "quick": quick})
        for point in varied
    ]


def _by_priority(results: list[tuple[int, Key]]) -> list[Key]:
    return [key for _, key in sorted(results, key=lambda pair: pair[0])]


def _begin(session: Session, key: Key, quick: bool) -> Work:
    """Render the images of a measurement; returns the function that evaluates them."""
    view = key["scene"]
    quality = points.quality_of(key["quality"])
    frame, times = time_point(session, view, quality, QUICK if quick else FULL)
    image, reference = frame["rgb"], session.reference(view, quality)
    scene = session.scene(view, quality.marker)
    return lambda: times | compare_image(image, reference, scene, quality)
