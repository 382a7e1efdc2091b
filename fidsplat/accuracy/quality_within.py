"""From a bound on the error, on the time, or on both, to the quality that keeps it."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from fidsplat.accuracy import cache, price_list
from fidsplat.accuracy.error import draws_float64
from fidsplat.accuracy.price_list import FREE, Candidate
from fidsplat.accuracy.search import Calibration, Search
from fidsplat.cameras import Camera
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality, whole_number
from fidsplat.capture.sensor import Sensor
from fidsplat.render.certified_error import cutoff_of, nothing_left_out
from fidsplat.render.renderer import Renderer, default_device
from fidsplat.scenes import Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.store import Store
from fidsplat.util.arguments import as_float
from fidsplat.util.errors import DeviceError, InputError
from fidsplat.util.provenance import code_hash, digest_of


@dataclass(frozen=True)
class Choice:
    """A quality, and why it was chosen."""

    quality: Quality
    error: float
    """largest absolute error of rgb: measured on the scene, or else promised by the price list"""
    ms: float | None
    """median time of a frame, milliseconds; None where nothing was timed"""
    ms_late: float | None
    """90th percentile"""
    source: str
    """`prices`, `measured`, or `kept`: measured before, and read from the user's cache folder"""
    device: str
    """name of the device"""
    knobs: dict[str, Any]
    """where it differs from what a budget starts from (`price_list.FREE`)"""
    certified: float | None = None
    """largest value of the output `error`, where it was rendered (`certify`)"""
    remark: str = ""
    """of a promise the class of scenes; else why there is no certificate"""

    def as_dict(self) -> dict[str, Any]:
        """For JSON: all but the quality itself, and what it takes to make it again."""
        keys = ("error", "ms", "ms_late", "source", "device", "knobs", "certified", "remark")
        return {key: getattr(self, key) for key in keys}

    @property
    def summary(self) -> str:
        """One line for people."""
        knobs = ", ".join(
            f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in ({"alpha_cutoff": self.quality.alpha_cutoff} | self.knobs).items()
        )
        how = "promised error" if self.source == "prices" else "measured error"
        sure = "" if self.certified is None else f", certified at most {self.certified:.2g}"
        took = "" if self.ms is None else f", {self.ms:.3g} ms a frame"
        remark = f" ({self.remark})" if self.remark else ""
        return f"{knobs}: {how} {self.error:.2g}{sure}{took} on {self.device}{remark}"


LAYERS = 100
"""faint fragments of a pixel, at most, in scenes of which nothing is known"""


@dataclass(frozen=True)
class SceneClass:
    """The scenes for which a quality is promised that nobody has measured there."""

    layers: int
    """opacity of a pixel's fragments below the cut-off, in all, over the cut-off; at most"""
    colors: float
    """range of the colours of splats and background, at most"""

    def promised(self, candidate: Candidate, base: Quality) -> float:
        """Error of a candidate's images at most: each fragment that the cut-off leaves out moves a colour by
        its opacity times the colours' range, the stop by the transmittance that it leaves; and what float32
        was measured to add."""
        quality = candidate.of(base)
        skipped = self.layers * quality.alpha_cutoff + quality.transmittance_stop
        return self.colors * (skipped + candidate.promised)

    def __str__(self) -> str:
        return f"for colours of a range of {self.colors:g} and at most {self.layers} faint layers at a pixel"


def quality_within(
    error: float | None = None,
    ms: float | None = None,
    *,
    scene: Scene | SplatCloud | Store | None = None,
    capture: Capture | Camera | None = None,
    device: str | Renderer | None = None,
    layers: int = LAYERS,
    colors: float = 1.0,
) -> Quality:
    """The cheapest quality that keeps an error, or the most accurate one that keeps a time.

    The error is the largest absolute difference of rgb, over all pixels and channels and before any sensor,
    from the same definition at full precision in float64 (`fidsplat.accuracy.error.truth`). The definition
    (low-pass, samples, order, marker) is that of the capture's quality.

    With the error alone the answer is a promise for a class of scenes: at no pixel do the fragments below the
    cut-off add up to more opacity than `layers` times the cut-off, as in every scene of at most `layers`
    splats, and colours and background range over no more than `colors`. What cut-off and stop leave out is
    then bounded; float32's rounding is taken from a list of errors over random scenes. With a scene and a
    camera the error is measured: on this device, in that scene, from there. What was measured is kept in the
    user's cache folder. docs/budget.md says how often each promise was kept.

    Args:
        error: largest error allowed.
        ms: milliseconds that nine frames of ten may take, with the splats on the device and the picture left
            there; needs a scene and a camera.
        scene: what is drawn. Of a store half of the error goes to levels of detail (`Quality.detail_error`),
            if what they cost was measured; with `ms` alone several such errors are tried.
        capture: how; or a camera alone. By default a Scene's own.
        device: a device's name or a Renderer; by default that of `Renderer()`.
        layers, colors: the class of scenes, without a scene.

    Raises:
        InputError: no bound, one that is no finite number, or one that nothing keeps; the message says what
            the best possible is.
        DeviceError: the device cannot be used or fails.
    """
    return choose(error, ms, scene, capture, device, layers=layers, colors=colors).quality


def choose(
    error: float | None = None,
    ms: float | None = None,
    scene: Scene | SplatCloud | Store | None = None,
    capture: Capture | Camera | None = None,
    device: str | Renderer | None = None,
    tell: Callable[[str], None] = lambda text: None,
    layers: int = LAYERS,
    colors: float = 1.0,
) -> Choice:
    """As `quality_within`, with what is known about the quality beside it. `tell`: called with what is done.

    Raises:
        InputError: as `quality_within`. DeviceError: the device cannot be used or fails.
    """
    check_bounds(error, ms)
    if scene is not None and not isinstance(scene, (Scene, SplatCloud, Store)):
        raise InputError(f"scene is a {type(scene).__name__}; give a SplatCloud, a Scene or a Store")
    if isinstance(scene, Store):
        scene = Scene(stores=(scene,))
    own = scene.capture if isinstance(scene, Scene) else Capture()
    asked = capture if isinstance(capture, Capture) else own.with_(camera=capture)
    asked = replace(asked, camera=asked.camera or own.camera, outputs=("rgb",), sensor=Sensor())
    for name, given in (("scene", scene), ("camera", asked.camera)):
        if given is None and (ms is not None or scene is not None or asked.camera is not None):
            raise InputError(f"this budget needs a {name} to measure with: give scene=... and capture=...")
    renderer = device if isinstance(device, Renderer) else Renderer(device or default_device())
    candidates = price_list.load(renderer.device.kind)
    if scene is None:
        assert error is not None
        scenes = SceneClass(whole_number("layers", layers, 1, 2**31 - 1), _color_range(colors))
        return _from_list(error, scenes, candidates, asked.quality, renderer)
    splats = scene.splats if isinstance(scene, Scene) else scene
    chunked = splats if isinstance(splats, ChunkedSplats) else None
    bases = [asked.quality]
    if chunked is not None:  # of an error levels of detail have half
        allowed = [0.0, *DETAILS] if error is None else [min(max(error, 0.0) / 2, DETAILS[-1])]
        bases = [_with_detail(chunked, asked.quality, detail) for detail in allowed]
        asked = replace(asked, quality=asked.quality.with_(detail_error=0.0))
    info = renderer.device
    drawn_by = (info.name, info.title, info.platform, info.version, code_hash())
    key = _key(drawn_by, (error, ms), asked, bases, chunked.content if chunked is not None else splats)
    kept = _kept(key, asked.quality, info.name)
    if kept is not None:
        return kept
    calibration = Calibration(renderer, splats if chunked is None else scene, asked, tell)

    def measured(base: Quality) -> Choice:
        calibration.base = base  # the truth of all is the same
        return _measured(Search(calibration, candidates), error, ms)

    choice = _best_of(dict.fromkeys(bases), measured)
    numbers = {"error": choice.error, "ms": choice.ms, "ms_late": choice.ms_late}
    cache.save(key, {"knobs": choice.knobs, **numbers})
    return choice


DETAILS = (1 / 255, 4 / 255, 16 / 255, 0.5)
"""errors of levels of detail that are tried where the time alone is bounded"""


def _with_detail(chunked: ChunkedSplats, quality: Quality, error: float) -> Quality:
    """A quality that may spend an error on levels of detail, where what they cost was measured."""
    detailed = quality.with_(detail_error=error)
    try:
        pixels = chunked.cell_sizes(detailed)
        useful = isinstance(pixels, tuple) and any(map(any, pixels))
        return detailed if useful else quality.with_(detail_error=0.0)
    except InputError:
        return quality.with_(detail_error=0.0)


def _best_of(bases: Iterable[Quality], choose_with: Callable[[Quality], Choice]) -> Choice:
    """The choice with the least error, of qualities that allow levels of detail more and more; those that
    allow more than it has are not tried."""
    best, refused = None, None
    for base in bases:
        if best is not None and best.error <= base.detail_error:
            break
        try:
            choice = choose_with(base)
        except InputError as error:
            refused = error
            continue
        if best is None or choice.error < best.error:
            detail = {"detail_error": base.detail_error} if base.detail_error else {}
            best = replace(choice, knobs=choice.knobs | detail)
    if best is None:
        assert refused is not None
        raise refused
    return best


def check_bounds(error: float | None, ms: float | None) -> None:
    """Raises InputError for bounds that are no numbers. Only measuring shows which of the others cannot be
    kept."""
    if error is None and ms is None:
        raise InputError("an empty budget: give error=1e-3, or ms=20 with scene=... and capture=...")
    for name, value, example in (("error", error, "1e-3"), ("ms", ms, "20")):
        if value is not None and not math.isfinite(as_float(value)):
            raise InputError(f"{name} is {value!r}; it must be a finite number, e.g. {name}={example}")


def _color_range(value: Any) -> float:
    if not 0 < (found := as_float(value)) < math.inf:
        raise InputError(f"colors must be a positive range, got {value!r}; give the largest colour, e.g. 1.0")
    return found


def _from_list(
    error: float, scenes: SceneClass, candidates: tuple[Candidate, ...], base: Quality, renderer: Renderer
) -> Choice:
    name = renderer.device.name
    for candidate in candidates:
        drawn = _drawn(candidate, base, renderer) if scenes.promised(candidate, base) <= error else None
        if drawn is not None:
            most = scenes.promised(drawn, base)
            return Choice(drawn.of(base), most, None, None, "prices", name, drawn.knobs, remark=str(scenes))
    finest = sorted(candidates, key=lambda candidate: scenes.promised(candidate, base))
    best = next(scenes.promised(candidate, base) for candidate in finest if _drawn(candidate, base, renderer))
    raise InputError(
        f"error must be at least {best:.2g} to be promised {scenes} on {name}, got {error:g}; allow that, "
        "name fewer layers, or give scene=... and capture=... to measure yours"
    )


TIGHTER = 1 / 16
"""cut-off and stop of the next quality that is tried, over those of one whose error is not certified"""


def certify(
    choice: Choice,
    error: float,
    ms: float | None,
    scene: Scene,
    capture: Capture,
    renderer: Renderer,
    tell: Callable[[str], None] = lambda text: None,
) -> Choice:
    """The choice, or one of finer cut-off and stop, with an image whose output `error` is nowhere above
    `error`. Where the output is refused, the choice as it was measured, with the reason as its remark.

    Raises:
        InputError: the finest quality is not certified either, or takes longer than `ms`; the message says
            what is possible.
    """
    plain = replace(capture, outputs=("error",), sensor=Sensor())
    resident, quality = renderer.upload(scene), choice.quality
    cutoff, double = cutoff_of(len(resident)), draws_float64(renderer, plain)
    while True:
        tell(f"certifying a cut-off of {quality.alpha_cutoff:.2g} in {quality.blend_precision}")
        try:
            frame = renderer.render(resident, plain.with_(quality=quality))
        except InputError as refused:
            return replace(choice, remark=f"not certified: {refused}")
        certified = float(frame["error"].max(initial=0.0))
        if certified <= error:
            break
        if quality.alpha_cutoff > cutoff:
            left = max(TIGHTER * quality.alpha_cutoff, cutoff)
            stop = TIGHTER * quality.transmittance_stop if left > cutoff else 0.0
            quality = nothing_left_out(quality, left).with_(transmittance_stop=stop)
            continue
        if double and quality.blend_precision == "float32":
            quality = quality.with_(blend_precision="float64", arithmetic="precise")
            continue
        raise InputError(
            f"error must be at least {certified:.2g} to be certified for this scene on {choice.device}, got "
            f"{error:g}; allow that"
        )
    if quality == choice.quality:
        return replace(choice, certified=certified)
    timed = Calibration(renderer, scene, plain.with_(outputs=("rgb",)), tell)
    (times,) = timed.times([quality])
    if ms is not None and times.late > ms:
        raise InputError(
            f"an error that is certified to be at most {error:g} takes {times.late:.3g} ms a frame on "
            f"{choice.device}, not {ms:g}; allow one of the two more"
        )
    knobs = {name: getattr(quality, name) for name, free in FREE.items() if getattr(quality, name) != free}
    # a bound of the error stands in for one that was not measured
    return Choice(
        *(quality, certified, times.median, times.late, "measured", choice.device, knobs), certified=certified
    )


def _drawn(candidate: Candidate, base: Quality, renderer: Renderer) -> Candidate | None:
    """The candidate, or what keeps its promise without the knobs that the device lacks, or None."""
    if candidate == candidate.everywhere:
        return candidate
    pixel = Camera.pinhole(1, 1, 1.0, 1.0, 0.5, 0.5)
    try:
        renderer.render(SplatCloud.empty(), pixel, quality=candidate.of(base))
    except (InputError, DeviceError):
        return None if "blend_precision" in candidate.knobs else candidate.everywhere
    return candidate


def _key(*question: object) -> str | None:
    """None where something in a question is no data, as a function of time that moves a camera."""
    try:
        return digest_of(question)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None


def _kept(key: str | None, base: Quality, device: str) -> Choice | None:
    """The answer of before, if there is one that can still be understood."""
    kept = cache.load(key)
    try:
        if kept is None:
            return None
        candidate = Candidate(kept["knobs"], 0, 0, 0, 0)
        error, ms, late = (float(kept[name]) for name in ("error", "ms", "ms_late"))
        return Choice(candidate.of(base), error, ms, late, "kept", device, candidate.knobs)
    except (KeyError, TypeError, ValueError, AttributeError):
        return None


def _measured(search: Search, error: float | None, ms: float | None) -> Choice:
    if error is None:
        assert ms is not None
        found = search.most_accurate_in(ms)
    else:
        found = search.cheapest_within(error)
        if ms is not None and found.times.late > ms:
            raise InputError(
                f"an error of {error:g} takes {found.times.late:.3g} ms a frame on {search.device}, not "
                f"{ms:g}; {_best_in(search, ms)}"
            )
    times, candidate = found.times, found.candidate
    return Choice(
        found.quality, found.error, times.median, times.late, "measured", search.device, candidate.knobs
    )


def _best_in(search: Search, ms: float) -> str:
    try:
        return f"the least error in that time is {search.most_accurate_in(ms).error:.2g}"
    except InputError as error:
        return str(error)
