"""The settings that are measured: each knob over a ladder, constants of others in an exact picture, presets,
useful combinations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from fidsplat.capture.quality import (
    BY_FORMULA,
    ELLIPSOID,
    PRESETS,
    TEMPLATE_SIZES,
    MarkerQuality,
    Quality,
)
from fidsplat.experiments.bench.catalogue import TIMED
from fidsplat.util.errors import InputError, unknown

BASE = TIMED.with_(marker=MarkerQuality("fitted"))
"""what every other setting is measured beside, turn by turn: the cut-off and the stop that other systems
share, and our rules; pinned, so that presets and defaults may change"""
EXACT = Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise", marker=BASE.marker)
"""what leaves nothing out that float32 can show; a constant put into this alone shows the error it makes"""
SHARP = {"lowpass": "none", "samples": 3}
"""for markers: exact splats, the mean of 3 x 3 samples"""

# knob -> (its values, in which kinds of scenes: r random and hard, m markers, t of 3D Gaussians)
_BY_FORMULA: dict[str, tuple[tuple[Any, ...], str]] = {
    "alpha_cutoff": (
        (1e-6, 1e-5, 1e-4, 1 / 4096, 1 / 2048, 1 / 1024, 1 / 512, 2 / 255, math.exp(-4.5), 4 / 255),
        "rm",
    ),
    "transmittance_stop": ((0.0, 1e-6, 1e-5, 1e-3, 1 / 512, 1 / 256, 1e-2), "rm"),
    "opacity_ceiling": ((0.999, 0.99), "rm"),
    "stop_rule": (("exclusive",), "rm"),
    "order": (("pixel", "centre"), "rm"),
    "ellipsoid": (ELLIPSOID, "t"),
    "lowpass": (("pixel", "none"), "rm"),
    "samples": ((2, 3), "rm"),
    "setup_precision": (("float32",), "rm"),
    "arithmetic": (("fast",), "rm"),
    "blend_precision": (("float64",), "rm"),
}
_QUICK = {
    "alpha_cutoff": (1e-4, 1 / 1024, 2 / 255),
    "transmittance_stop": (0.0, 1 / 512),
    "lowpass": ("none",),
    "samples": (2,),
}
_MARKER_LADDER = (
    *(MarkerQuality("paper", levels=levels, density=1) for levels in (1, 2, 3, 4, 5)),
    MarkerQuality("paper"),
    *(
        replace(BASE.marker, template=k)
        for k in TEMPLATE_SIZES
        if k not in (BASE.marker.template, *BY_FORMULA)
    ),
    *(replace(BASE.marker, growth=growth) for growth in (0.0, 0.2)),
    MarkerQuality("exact"),
)
_QUICK_MARKERS = (MarkerQuality("paper"), MarkerQuality("exact"))
_COMBINED_CUTOFFS, _COMBINED_STOPS = (1e-4, 1 / 4096, 1 / 2048, 1 / 1024, 1 / 255), (1e-4, 1e-3, 1 / 512)
_FAST, _FASTEST = {"arithmetic": "fast"}, {"arithmetic": "fast", "setup_precision": "float32"}
_FASTEST_STOP = 1e-3

_ALONE: tuple[dict[str, Any], ...] = (
    {"alpha_cutoff": 1 / 255},
    {"alpha_cutoff": math.exp(-4.5)},
    {"transmittance_stop": 1e-4},
    {"transmittance_stop": 1 / 256},
    {"opacity_ceiling": 0.99},
    {"stop_rule": "exclusive", "transmittance_stop": 1e-4, "order": "centre"},
    {"lowpass": "none"},
    {"setup_precision": "float32"},
    {"arithmetic": "fast"},
)
"""constants that are put into `EXACT`, one at a time"""

_FRACTIONS = {
    above / below: f"{above}/{below}"
    for above, below in (
        (1, 255), (2, 255), (4, 255), (1, 256), (1, 512), (1, 1024), (1, 2048), (1, 4096),
    )
}  # fmt: skip

PRESETS_KNOB, ALONE, TOGETHER, MARKER_KNOB = "preset", "alone", "together", "marker"
KNOBS = (PRESETS_KNOB, ALONE, *_BY_FORMULA, MARKER_KNOB, TOGETHER)
"""what --knobs takes"""


@dataclass(frozen=True)
class Point:
    """One setting."""

    knob: str
    """one of `KNOBS`, or `base`"""
    value: str
    """what it is turned to, in words"""
    quality: Quality

    def key(self) -> dict:
        """For the key of a result: the setting by what it changes in the base."""
        changes = _changes(asdict(self.quality), asdict(BASE))
        return {"knob": self.knob, "value": self.value, "quality": changes}


def quality_of(changes: dict) -> Quality:
    """The setting of a key's `quality`."""
    marker = replace(BASE.marker, **changes.get("marker", {}))
    return BASE.with_(**changes | {"marker": marker})


def _changes(values: dict, others: dict) -> dict:
    """What differs of nested values, and to what."""
    return {
        name: _changes(value, others[name]) if isinstance(value, dict) else value
        for name, value in values.items()
        if value != others[name]
    }


def knob_names(words: Iterable[str]) -> tuple[str, ...]:
    """Names of knobs from words, each once; none: all of them.

    Raises:
        InputError: a name that no knob has.
    """
    names = tuple(dict.fromkeys(words)) or KNOBS
    for name in names:
        if name not in KNOBS:
            raise InputError(unknown("knob", name, KNOBS))
    return names


def points(
    knobs: Iterable[str], on_marker: bool, quick: bool = False, every_ladder: bool = True
) -> list[Point]:
    """The settings for one kind of scene, the most telling ones first, each once.

    every_ladder: whether each knob alone is turned; else only presets, and how markers are made.

    The base itself is the first: its own error, and its time beside itself, which shows the noise.
    """
    chosen = tuple(knobs)
    found = [Point("base", "base", BASE)]
    if PRESETS_KNOB in chosen:
        # surfel has the same constants as gsplat
        found += [Point(PRESETS_KNOB, name, preset(name)) for name in PRESETS if name != "surfel"]
    if ALONE in chosen and not on_marker:
        found.append(Point(ALONE, "exact", EXACT))
        found += [alone(changes) for changes in (_ALONE[:6] if quick else _ALONE)]
    if MARKER_KNOB in chosen and on_marker:
        found += _marker_points(quick)
    for knob, (values, kinds) in _BY_FORMULA.items() if every_ladder else ():
        if knob in chosen and ("m" if on_marker else "r") in kinds:
            for value in _QUICK.get(knob, values) if quick else values:
                found.append(_turned(knob, value))
    if TOGETHER in chosen and not on_marker:
        found += _together(quick)
    return list({(point.knob, point.value): point for point in found}.values())


def thick_points(knobs: Iterable[str]) -> list[Point]:
    """The settings for scenes of 3D Gaussians: the base, and the ways of drawing them in pictures that are
    exact otherwise."""
    values = _BY_FORMULA["ellipsoid"][0] if "ellipsoid" in tuple(knobs) else ()
    ways = (Point("ellipsoid", value, EXACT.with_(ellipsoid=value)) for value in values)
    return [Point("base", "base", BASE), *ways]


def decode_points(knobs: Iterable[str], quick: bool = False) -> list[Point]:
    """The settings whose markers are tilted until no detector reads them: what changes edges."""
    chosen = tuple(knobs)
    found = [Point("base", "base", BASE)]
    if PRESETS_KNOB in chosen:
        found.append(Point(PRESETS_KNOB, "gsplat", preset("gsplat")))
    if MARKER_KNOB in chosen:
        found += _marker_points(quick)
    for knob in ("lowpass", "samples"):
        if knob in chosen and not quick:
            found += [_turned(knob, value) for value in _BY_FORMULA[knob][0]]
    return found


def preset(name: str) -> Quality:
    """A preset, with markers as the base has them."""
    return PRESETS[name].with_(marker=BASE.marker)


def marker_words(knobs: MarkerQuality) -> str:
    """A marker's knobs in words, e.g. "paper L3 x1"."""
    if knobs.mixture == "paper":
        words = f"paper L{knobs.levels} x{knobs.density}"
    else:
        words = f"fitted {knobs.template}" if knobs.mixture == "fitted" else knobs.mixture
    return words if knobs.growth is None else f"{words} growth {knobs.growth:g}"


def alone(changes: dict[str, Any]) -> Point:
    """A constant in the setting that is exact otherwise."""
    knob, value = next(iter(changes.items()))
    return Point(ALONE, f"{knob} {value_words(value)}", EXACT.with_(**changes))


def _turned(knob: str, value: Any) -> Point:
    changes = {knob: value}
    if value == "exclusive":
        changes["order"] = "centre"  # the exclusive stop knows no layers
    return Point(knob, value_words(value), BASE.with_(**changes))


def value_words(value: Any) -> str:
    """A knob's value; fractions that systems write as such stay such."""
    if value in _FRACTIONS:
        return _FRACTIONS[value]
    if value == math.exp(-4.5):
        return "3 sigma"  # where an opaque splat has fallen to that
    return f"{value:g}" if isinstance(value, float) else str(value)


def _marker_points(quick: bool) -> Iterator[Point]:
    """Every way of making a marker, drawn as the base and by `SHARP`."""
    for knobs in (BASE.marker, *(_QUICK_MARKERS if quick else _MARKER_LADDER)):
        words = marker_words(knobs)
        if knobs != BASE.marker:
            yield Point(MARKER_KNOB, words, BASE.with_(marker=knobs))
        if knobs.mixture != "exact":  # boxes filter themselves
            yield Point(MARKER_KNOB, f"{words}, 3 x 3", BASE.with_(marker=knobs, **SHARP))


def _together(quick: bool) -> Iterator[Point]:
    """Cut-off and stop together, in precise and in fast arithmetic, and some with a float32 set-up too."""
    cutoffs = _COMBINED_CUTOFFS[1::2] if quick else _COMBINED_CUTOFFS
    for more, words in (({}, ""), (_FAST, ", fast"), (_FASTEST, ", fast, float32 set-up")):
        stops = (_FASTEST_STOP,) if quick or more is _FASTEST else _COMBINED_STOPS
        for cutoff in cutoffs:
            for stop in stops:
                if not more and (cutoff == BASE.alpha_cutoff or stop == BASE.transmittance_stop):
                    continue  # that is one knob alone
                changes = {"alpha_cutoff": cutoff, "transmittance_stop": stop, **more}
                value = f"cutoff {value_words(cutoff)}, stop {value_words(stop)}{words}"
                yield Point(TOGETHER, value, BASE.with_(**changes))
