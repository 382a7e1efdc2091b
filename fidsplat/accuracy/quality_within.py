"""Choice of the quality within a bound on the error, on the frame time, or on both (`quality_within`)."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fidsplat.accuracy import candidates
from fidsplat.accuracy.candidates import MARGIN, Candidate, Choice
from fidsplat.accuracy.search import CandidateSearch, SceneMeasurement, p90_ms
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality, whole_number
from fidsplat.capture.sensor import Sensor
from fidsplat.render.renderer import Renderer, default_device
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.store import Store
from fidsplat.util.arguments import as_float
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.files import from_json, read_text, user_cache, write_json
from fidsplat.util.provenance import code_hash, digest_of

FAINT_FRAGMENTS = 100
"""default maximum number of fragments below the cut-off at a pixel"""
DETAIL_ERRORS = (1 / 255, 4 / 255, 16 / 255, 0.5)
"""errors of levels of detail that are tried if only the time is bounded"""


def quality_within(
    error: float | None = None,
    ms: float | None = None,
    *,
    scene: Scene | SplatCloud | Store | None = None,
    capture: Capture | Camera | None = None,
    device: str | Renderer | None = None,
    faint_fragments: int = FAINT_FRAGMENTS,
    colors: float = 1.0,
) -> Quality:
    """Choose the fastest quality within an error, or the most accurate quality within a frame time.

    The error is the largest absolute difference of rgb, without sensor, from the same image at full precision
    in float64 (`fidsplat.accuracy.error.reference_image`). Low-pass, samples, order and markers are those of
    the capture's quality.

    Without a scene, the error is promised for a class of scenes: at each pixel, the opacities of the
    fragments below the cut-off sum to at most `faint_fragments` times the cut-off (true for at most as many
    splats), and colours and background have a range of at most `colors`. The errors of cut-off and stop are
    bounded for this class; the error of float32 rounding was measured over random scenes (docs/accuracy.md).

    With a scene and a camera, the error is measured in that scene on this device, and the choice is cached in
    the user's cache folder.

    Args:
        error: largest allowed error.
        ms: largest allowed 90th percentile of the frame time in milliseconds, with splats and image on the
            device; requires a scene and a camera.
        scene: scene in which errors and times are measured. Levels of detail of a store may use half of the
            error (`Quality.detail_error`), if the store's errors are measured; with `ms` alone, several such
            errors are tried.
        capture: capture or camera of the measurement; default: the scene's own.
        device: name of a device, or a Renderer; default: the device of `Renderer()`.
        faint_fragments, colors: class of scenes, without a scene.

    Raises:
        InputError: a bound is missing, invalid, or not possible; the message names the smallest possible
            value.
        DeviceError: the device cannot be used or fails.
    """
    return choose(error, ms, scene, capture, device, faint_fragments=faint_fragments, colors=colors).quality


def choose(
    error: float | None = None,
    ms: float | None = None,
    scene: Scene | SplatCloud | Store | None = None,
    capture: Capture | Camera | None = None,
    device: str | Renderer | None = None,
    report: Callable[[str], None] = lambda message: None,
    faint_fragments: int = FAINT_FRAGMENTS,
    colors: float = 1.0,
) -> Choice:
    """Choose a quality as `quality_within` does; returns it with its error and time.

    report: called with the current step.
    """
    check_bounds(error, ms)
    if scene is not None and not isinstance(scene, (Scene, SplatCloud, Store)):
        raise InputError(f"scene must be a SplatCloud, a Scene or a Store, got a {type(scene).__name__}")
    if isinstance(scene, Store):
        scene = Scene(stores=(scene,))
    default = scene.capture if isinstance(scene, Scene) else Capture()
    requested = capture if isinstance(capture, Capture) else default.with_(camera=capture)
    camera = requested.camera or default.camera
    requested = replace(requested, camera=camera, outputs=("rgb",), sensor=Sensor())
    for name, value in (("scene", scene), ("camera", camera)):
        if value is None and (ms is not None or scene is not None or camera is not None):
            what = "ms" if ms is not None else "an error to measure"
            raise InputError(f"{name} must be given with {what}, got none; pass scene=... and capture=...")
    renderer = device if isinstance(device, Renderer) else Renderer(device or default_device())
    pareto_front = candidates.load(renderer.device.kind)
    if scene is None:
        assert error is not None
        scenes = SceneClass(
            whole_number("faint_fragments", faint_fragments, 1, 2**31 - 1), _color_range(colors)
        )
        return _promised(error, scenes, pareto_front, requested.quality, renderer)
    splats = scene.splats if isinstance(scene, Scene) else scene
    bases, content = [requested.quality], splats
    if isinstance(splats, ChunkedSplats):
        content = splats.content
        # levels of detail may use half of the error; the search measures the sum, since errors that `store
        # measure` found in other views do not bound the error of this view
        allowed = [0.0, *DETAIL_ERRORS] if error is None else [min(max(error, 0) / 2, DETAIL_ERRORS[-1]), 0.0]
        bases = [_with_detail(splats, requested.quality, detail) for detail in allowed]
        requested = replace(requested, quality=requested.quality.with_(detail_error=0.0))
    info = renderer.device
    measured_by = (info.name, info.title, info.platform, info.version, code_hash())
    key = _key(measured_by, (error, ms), requested, bases, content)
    cached = _cached(key, requested.quality, info.name)
    if cached is not None:
        return cached
    measurement = SceneMeasurement(renderer, scene, requested, report)

    def search_with(base: Quality) -> Choice:
        measurement.base = base  # all bases have the same reference image
        return _search(CandidateSearch(measurement, pareto_front), error, ms)

    choice = _best_of(dict.fromkeys(bases), search_with, first=error is not None)
    _save(key, choice)
    return choice


def check_bounds(error: float | None, ms: float | None) -> None:
    """Raise InputError if both bounds are missing, or one is not a finite number."""
    if error is None and ms is None:
        raise InputError(
            "quality_within must have a bound, error or ms, got neither; give error=1e-3, or ms=20 with "
            "scene=... and capture=..."
        )
    for name, value, example in (("error", error, "1e-3"), ("ms", ms, "20")):
        if value is not None and not math.isfinite(as_float(value)):
            raise InputError(f"{name} must be a finite number, got {value!r}; try {name}={example}")


def _color_range(value: Any) -> float:
    if not 0 < (number := as_float(value)) < math.inf:
        raise InputError(
            f"colors must be a positive number, got {value!r}; give the largest minus the smallest colour, "
            "e.g. 1.0"
        )
    return number


@dataclass(frozen=True)
class SceneClass:
    """Class of scenes for which an error is promised without a measurement."""

    faint_fragments: int
    """maximum sum of the opacities of a pixel's fragments below the cut-off, divided by the cut-off"""
    colors: float
    """maximum range of the colours of splats and background"""

    def promised_error(self, candidate: Candidate, base: Quality) -> float:
        """Promised error of a candidate: that of cut-off, stop and float32 rounding.

        Omitting a fragment changes a colour by at most its opacity times the range of colours; the stop omits
        at most the remaining transmittance.
        """
        quality = candidate.quality(base)
        omitted = self.faint_fragments * quality.alpha_cutoff + quality.transmittance_stop
        return self.colors * (omitted + MARGIN * candidate.error_max)

    def __str__(self) -> str:
        count = self.faint_fragments
        return f"for colours of a range of {self.colors:g} and at most {count} faint fragments at a pixel"


def _promised(
    error: float, scenes: SceneClass, pareto_front: tuple[Candidate, ...], base: Quality, renderer: Renderer
) -> Choice:
    """The fastest candidate whose promised error is within the bound."""
    name = renderer.device.name
    for candidate in pareto_front:
        # the rounding error of float16 grows with the number of fragments
        unbounded = candidate.settings.get("blend_precision") == "float16"
        if unbounded or scenes.promised_error(candidate, base) > error:
            continue
        supported = _supported(candidate, base, renderer)
        if supported is not None:
            promised = scenes.promised_error(supported, base)
            quality, settings = supported.quality(base), supported.settings
            return Choice(quality, promised, None, None, "promised", name, settings, remark=str(scenes))
    by_error = sorted(pareto_front, key=lambda candidate: scenes.promised_error(candidate, base))
    lowest = next(
        scenes.promised_error(candidate, base)
        for candidate in by_error
        if _supported(candidate, base, renderer)
    )
    raise InputError(
        f"error must be at least {lowest:.2g}, the lowest bound {scenes} on {name}, got {error:g}; allow a "
        "larger error, lower faint_fragments, or give scene=... and capture=... to measure the error"
    )


def _supported(candidate: Candidate, base: Quality, renderer: Renderer) -> Candidate | None:
    """The candidate if the device supports it, else its portable copy if that is as accurate, else None."""
    if candidate == candidate.portable:
        return candidate
    pixel = Camera.pinhole(1, 1, 1.0, 1.0, 0.5, 0.5)
    try:
        renderer.render(SplatCloud.empty(), pixel, quality=candidate.quality(base))
    except (InputError, DeviceError):
        return None if "blend_precision" in candidate.settings else candidate.portable
    return candidate


def _search(search: CandidateSearch, error: float | None, ms: float | None) -> Choice:
    if error is None:
        assert ms is not None
        return search.most_accurate_in(ms)
    choice = search.fastest_within(error)
    if ms is not None and p90_ms(choice) > ms:
        raise InputError(
            f"ms must be at least {p90_ms(choice):.3g} on {search.device} for an error of {error:g}, got "
            f"{ms:g}; {_best_in(search, ms)}"
        )
    return choice


def _best_in(search: CandidateSearch, ms: float) -> str:
    try:
        return f"the lowest error in that time is {search.most_accurate_in(ms).error:.2g}"
    except InputError as error:
        return str(error)


def _with_detail(splats: ChunkedSplats, quality: Quality, error: float) -> Quality:
    """The quality with this `detail_error`, or with 0 if it allows no level of detail of the stores."""
    detailed = quality.with_(detail_error=error)
    try:
        sizes = splats.cell_sizes(detailed)
        useful = isinstance(sizes, tuple) and any(map(any, sizes))
        return detailed if useful else quality.with_(detail_error=0.0)
    except InputError:
        return quality.with_(detail_error=0.0)


def _best_of(
    bases: Iterable[Quality], search_with: Callable[[Quality], Choice], first: bool = False
) -> Choice:
    """Search with base qualities of increasing `detail_error`; returns the choice with the lowest error.

    Bases whose `detail_error` is above the lowest error found are not tried. first: return the choice of the
    first base for which the search succeeds.
    """
    best, refused = None, None
    for base in bases:
        if best is not None and (first or best.error <= base.detail_error):
            break
        try:
            choice = search_with(base)
        except InputError as error:
            refused = error
            continue
        if best is None or choice.error < best.error:
            detail = {"detail_error": base.detail_error} if base.detail_error else {}
            best = replace(choice, settings=choice.settings | detail)
    if best is None:
        assert refused is not None
        raise refused
    return best


def _key(*arguments: object) -> str | None:
    """Cache key of the arguments of a search; None if they contain functions, e.g. a camera's motion."""
    try:
        return digest_of(arguments)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


def _cached(key: str | None, base: Quality, device: str) -> Choice | None:
    """The cached choice of a key; None if there is none or its file is damaged."""
    if key is None:
        return None
    try:
        value = from_json(read_text(cache_folder() / f"{key}.json"))
        candidate = Candidate(value["settings"], 0, 0, 0, 0)
        error, ms, p90 = (float(value[name]) for name in ("error", "ms", "ms_p90"))
        return Choice(candidate.quality(base), error, ms, p90, "cached", device, candidate.settings)
    except (OSError, KeyError, TypeError, ValueError, AttributeError):
        return None


def _save(key: str | None, choice: Choice) -> None:
    """Cache a choice; a failure to write is ignored."""
    if key is None:
        return
    value = {name: getattr(choice, name) for name in ("settings", "error", "ms", "ms_p90")}
    try:
        cache_folder().mkdir(parents=True, exist_ok=True)
        write_json(cache_folder() / f"{key}.json", value, indent=1)
    except (OSError, InputError):
        pass


def cache_folder() -> Path:
    """Cache folder of measured choices."""
    return user_cache() / "fidsplat" / "quality_within"
