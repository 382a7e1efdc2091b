"""Quality settings of the trade-off: values of each setting, constants of other renderers in an exact frame,
presets, and combinations."""

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
"""baseline of all comparisons: the cut-off and stop of other renderers with our rules; independent of presets
and defaults"""
EXACT = Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise", marker=BASE.marker)
"""reference quality in float32; a constant changed only here shows its own error"""
SHARP = {"lowpass": "none", "samples": 3}
"""quality of markers: exact splats, the mean of 3 x 3 samples"""

# setting -> (its values, kinds of scenes: r random and hard, m markers, t of 3D Gaussians)
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
"""constants that are changed in `EXACT`, one at a time"""

_FRACTIONS = {
    above / below: f"{above}/{below}"
    for above, below in (
        (1, 255), (2, 255), (4, 255), (1, 256), (1, 512), (1, 1024), (1, 2048), (1, 4096),
    )
}  # fmt: skip

PRESETS_KNOB, ALONE, TOGETHER, MARKER_KNOB = "preset", "alone", "together", "marker"
KNOBS = (PRESETS_KNOB, ALONE, *_BY_FORMULA, MARKER_KNOB, TOGETHER)
"""values of --knobs"""


@dataclass(frozen=True)
class Point:
    """A quality setting to measure."""

    knob: str
    """name in `KNOBS`, or `base`"""
    value: str
    """value as text"""
    quality: Quality

    def key(self) -> dict:
        """Differences from the base, for the key of a result."""
        changes = _changes(asdict(self.quality), asdict(BASE))
        return {"knob": self.knob, "value": self.value, "quality": changes}


def quality_of(changes: dict) -> Quality:
    """Point of a result key's `quality`."""
    marker = replace(BASE.marker, **changes.get("marker", {}))
    return BASE.with_(**changes | {"marker": marker})


def _changes(values: dict, others: dict) -> dict:
    """Nested values that differ."""
    return {
        name: _changes(value, others[name]) if isinstance(value, dict) else value
        for name, value in values.items()
        if value != others[name]
    }


def knob_names(words: Iterable[str]) -> tuple[str, ...]:
    """Distinct names of settings; all if none is given.

    Raises:
        InputError: an unknown setting.
    """
    names = tuple(dict.fromkeys(words)) or KNOBS
    for name in names:
        if name not in KNOBS:
            raise InputError(unknown("knob", name, KNOBS))
    return names


def points(
    knobs: Iterable[str], on_marker: bool, quick: bool = False, every_ladder: bool = True
) -> list[Point]:
    """Distinct points for one kind of scene, the most informative first.

    every_ladder: whether to vary each setting; else only presets and marker qualities.

    The base comes first: its own error, and its time relative to itself, which shows the noise.
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
    """Points of scenes with 3D Gaussians: the base, and the values of `ellipsoid` in exact frames."""
    values = _BY_FORMULA["ellipsoid"][0] if "ellipsoid" in tuple(knobs) else ()
    ways = (Point("ellipsoid", value, EXACT.with_(ellipsoid=value)) for value in values)
    return [Point("base", "base", BASE), *ways]


def decode_points(knobs: Iterable[str], quick: bool = False) -> list[Point]:
    """Points whose markers are tilted until no detector reads them: settings that change edges."""
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
    """A preset with the marker quality of the base."""
    return PRESETS[name].with_(marker=BASE.marker)


def marker_words(knobs: MarkerQuality) -> str:
    """Marker quality as text, e.g. "paper L3 x1"."""
    if knobs.mixture == "paper":
        words = f"paper L{knobs.levels} x{knobs.density}"
    else:
        words = f"fitted {knobs.template}" if knobs.mixture == "fitted" else knobs.mixture
    return words if knobs.growth is None else f"{words} growth {knobs.growth:g}"


def alone(changes: dict[str, Any]) -> Point:
    """A constant changed in `EXACT`."""
    knob, value = next(iter(changes.items()))
    return Point(ALONE, f"{knob} {value_words(value)}", EXACT.with_(**changes))


def _turned(knob: str, value: Any) -> Point:
    changes = {knob: value}
    if value == "exclusive":
        changes["order"] = "centre"  # the exclusive stop cannot composite layers
    return Point(knob, value_words(value), BASE.with_(**changes))


def value_words(value: Any) -> str:
    """Value as text; well-known fractions such as 1/255 are kept."""
    if value in _FRACTIONS:
        return _FRACTIONS[value]
    if value == math.exp(-4.5):
        return "3 sigma"  # cut-off of an opaque splat at 3 sigma
    return f"{value:g}" if isinstance(value, float) else str(value)


def _marker_points(quick: bool) -> Iterator[Point]:
    """Points of all marker qualities, rendered with the base and with `SHARP`."""
    for knobs in (BASE.marker, *(_QUICK_MARKERS if quick else _MARKER_LADDER)):
        words = marker_words(knobs)
        if knobs != BASE.marker:
            yield Point(MARKER_KNOB, words, BASE.with_(marker=knobs))
        if knobs.mixture != "exact":  # boxes are always filtered
            yield Point(MARKER_KNOB, f"{words}, 3 x 3", BASE.with_(marker=knobs, **SHARP))


def _together(quick: bool) -> Iterator[Point]:
    """Combinations of cut-off and stop, in precise and fast arithmetic, some with a float32 set-up."""
    cutoffs = _COMBINED_CUTOFFS[1::2] if quick else _COMBINED_CUTOFFS
    for more, words in (({}, ""), (_FAST, ", fast"), (_FASTEST, ", fast, float32 set-up")):
        stops = (_FASTEST_STOP,) if quick or more is _FASTEST else _COMBINED_STOPS
        for cutoff in cutoffs:
            for stop in stops:
                if not more and (cutoff == BASE.alpha_cutoff or stop == BASE.transmittance_stop):
                    continue  # a single setting
                changes = {"alpha_cutoff": cutoff, "transmittance_stop": stop, **more}
                value = f"cutoff {value_words(cutoff)}, stop {value_words(stop)}{words}"
                yield Point(TOGETHER, value, BASE.with_(**changes))
