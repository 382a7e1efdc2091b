"""Trade-off as a sweep: points in order of information, and their measurement."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from fidsplat.accuracy.error import REFERENCE_CUTOFF
from fidsplat.experiments.sweep import Key, Results, Sweep
from fidsplat.experiments.tradeoff import compare, linear, points, scenes
from fidsplat.experiments.tradeoff.points import ALONE, BASE, MARKER_KNOB, PRESETS_KNOB
from fidsplat.experiments.tradeoff.session import DEFINITION, FULL, QUICK, Session, time_point
from fidsplat.render.renderer import Renderer
from fidsplat.util.errors import FidsplatError, InputError
from fidsplat.util.files import writable_folder
from fidsplat.util.provenance import run_facts
from fidsplat.vision.metrics import metric_versions
from fidsplat.vision.readers import reader_versions

NAME = "tradeoff"
FILE = f"{NAME}.jsonl"
POINT, DECODE, TRUTH, LINEAR = "point", "decode", "truth", "linear"
IDEAL = "ideal"
_EARLY = ("base", PRESETS_KNOB, ALONE, "alpha_cutoff", "transmittance_stop", MARKER_KNOB)
_BATCH = 16
"""maximum number of points whose images wait for evaluation"""


@dataclass(frozen=True)
class TradeoffSettings:
    """Scenes, quality settings and length of a trade-off measurement."""

    scenes: tuple[str, ...] | None = None
    """Scenes to measure. By default all, with --quick four."""
    knobs: tuple[str, ...] | None = None
    """Quality settings to vary: names of Quality's fields, or preset, marker, together. By default all."""
    quick: bool = False
    """Measure few values, few frames and four scenes."""
    overwrite: bool = False
    """Measure again what the folder for results holds."""
    workers: int = min(_BATCH, os.cpu_count() or 1)
    """Number of threads that evaluate images while nothing is timed."""


@contextmanager
def prepared(
    options: TradeoffSettings, out: Path, device: str, own: scenes.Own | None = None
) -> Iterator[Sweep]:
    """Sweep with its renderer and results. A view that a device refuses is a result with `error`.

    Raises InputError for invalid options, DeviceError if the device cannot be opened.
    """
    own = own or {}
    keys = (
        own_points(own, options.knobs or (), options.quick)
        if own
        else all_points(options.scenes or (), options.knobs or (), options.quick)
    )
    renderer = Renderer(device)
    info = renderer.device
    if info.always_float64:
        raise InputError(f"--device must not be the reference itself, got {info.name}; give another --device")
    writable_folder(out)
    versions = reader_versions() | metric_versions() | {"pyopencl": version("pyopencl")}
    facts = run_facts(f"{info.title}, {info.version}", scenes.SEED, versions)
    facts |= {"kind": info.kind, "title": info.title} | ({"scene": scenes.digests(own)} if own else {})
    results = Results(out / FILE, facts, options.overwrite)
    session = Session(renderer, own)

    def begin(key: Key) -> Callable[[], dict]:
        try:
            return _begin(session, key, options.quick)
        except FidsplatError as error:
            message = str(error)
            return lambda: {"error": message}

    pool = ThreadPoolExecutor(options.workers)
    try:
        yield Sweep(f"{NAME} on {device}", results, keys, begin, options.workers, pool)
    finally:
        # an interrupt must not wait for pending images
        pool.shutdown(cancel_futures=True)


def all_points(names: tuple[str, ...], knobs: tuple[str, ...], quick: bool) -> list[Key]:
    """Points of a run.

    Raises:
        InputError: an unknown scene or setting.
    """
    chosen, turned = scenes.scene_names(names, quick), points.knob_names(knobs)
    found: list[tuple[int, Key]] = []
    for name in chosen:
        marked = scenes.is_marker(name)
        every = name not in scenes.FEW_KNOBS and not (marked and quick)
        for view in scenes.views_of(name):
            thick = name in scenes.THICK
            settings = points.thick_points(turned) if thick else points.points(turned, marked, quick, every)
            if name == "r1m_1080p":  # 18 million samples: minutes on a CPU; the smaller scene suffices
                settings = [point for point in settings if point.quality.samples <= 2]
            found += _view_points(view, settings, quick)
        if marked:
            tilts = compare.QUICK_TILTS if quick else compare.FULL_TILTS
            ideal = {"knob": IDEAL, "value": IDEAL, "quality": None}
            keys = [ideal, *(point.key() for point in points.decode_points(turned, quick))]
            found += [(1, {"what": DECODE, "scene": name, **key, "tilts": tilts}) for key in keys]
    if "ellipsoid" in turned and set(scenes.THICK) & set(chosen):
        found += [
            (1, {"what": LINEAR, "scene": "ball", "knob": f"{distance} sigma", "value": str(degrees)})
            for distance in linear.DISTANCES
            for degrees in linear.ANGLES
        ]
    return _in_order(found)


def own_points(views: Iterable[str], knobs: tuple[str, ...], quick: bool) -> list[Key]:
    """Points of the user's views, by view name.

    Raises:
        InputError: an unknown setting.
    """
    settings = points.points(points.knob_names(knobs), on_marker=False, quick=quick)
    return _in_order([pair for view in views for pair in _view_points(view, settings, quick)])


def _view_points(view: str, settings: Iterable[points.Point], quick: bool) -> list[tuple[int, Key]]:
    """Points of a view and checks of their reference images, with priorities."""
    found: list[tuple[int, Key]] = []
    defined: set[tuple] = set()
    for point in settings:
        tier = 0 if point.knob in _EARLY else 2
        found.append((tier, {"what": POINT, "scene": view, **point.key(), "quick": quick}))
        definition = tuple(getattr(point.quality, name) for name in DEFINITION)
        if point.knob != MARKER_KNOB and definition not in defined:
            defined.add(definition)
            found.append((tier + 1, _truth_key(view, definition)))
    return found


def _in_order(found: list[tuple[int, Key]]) -> list[Key]:
    return [key for _, key in sorted(found, key=lambda pair: pair[0])]


def _truth_key(view: str, definition: tuple) -> Key:
    return {"what": TRUTH, "scene": view, **dict(zip(DEFINITION, definition, strict=True))}


def _begin(session: Session, key: Key, quick: bool) -> Callable[[], dict]:
    view = key["scene"]
    if key["what"] == LINEAR:
        distance, degrees = float(key["knob"].removesuffix(" sigma")), float(key["value"])
        return lambda: {"maximum": linear.linear_error(distance, degrees)}
    if key["what"] == DECODE:
        quality = None if key["quality"] is None else points.quality_of(key["quality"])
        return compare.scan(session, view, quality, key["tilts"])
    if key["what"] == TRUTH:
        asked = BASE.with_(**{name: key[name] for name in DEFINITION})
        full, truth = session.full(view, asked), session.truth(view, asked)
        scene = session.scene(view, asked.marker)
        facts = {"blend_precision": full.blend_precision, "alpha_cutoff": REFERENCE_CUTOFF}
        return lambda: facts | compare.check_truth(truth, scene, full)
    quality = points.quality_of(key["quality"])
    frame, times = time_point(session, view, quality, QUICK if quick else FULL)
    picture, truth = frame["rgb"], session.truth(view, quality)
    scene = session.scene(view, quality.marker)
    return lambda: times | compare.compare_picture(picture, truth, scene, quality)
