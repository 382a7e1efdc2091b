"""Quality settings of the trade-off: single values, constants of other renderers, presets, combinations."""

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
"""baseline of all comparisons: cut-off and stop of other renderers, other settings as ours; independent of
presets and defaults"""
EXACT = Quality(alpha_cutoff=1e-6, transmittance_stop=0.0, arithmetic="precise", marker=BASE.marker)
"""reference quality in float32, in which one constant is changed to show the error of this constant"""
SHARP = {"lowpass": "none", "samples": 3}
"""quality of markers: the mean of 3 x 3 samples of unfiltered splats"""

_VALUES: dict[str, tuple[Any, ...]] = {
    "alpha_cutoff": (
        *(1e-6, 1e-5, 1e-4, 1 / 4096, 1 / 2048, 1 / 1024, 1 / 512),
        *(2 / 255, math.exp(-4.5), 4 / 255),
    ),
    "transmittance_stop": (0.0, 1e-6, 1e-5, 1e-3, 1 / 512, 1 / 256, 1e-2),
    "opacity_ceiling": (0.999, 0.99),
    "stop_rule": ("exclusive",),
    "order": ("pixel", "centre"),
    "ellipsoid": ELLIPSOID,
    "lowpass": ("pixel", "none"),
    "samples": (2, 3),
    "projection_precision": ("float32",),
    "arithmetic": ("fast", "approximate"),
    "blend_precision": ("float16", "float64"),
}
_QUICK_VALUES = _VALUES | {
    "alpha_cutoff": (1e-4, 1 / 1024, 2 / 255),
    "transmittance_stop": (0.0, 1 / 512),
    "lowpass": ("none",),
    "samples": (2,),
}
_MARKER_QUALITIES = (
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
_QUICK_MARKER_QUALITIES = (MarkerQuality("paper"), MarkerQuality("exact"))
_COMBINED_CUTOFFS, _COMBINED_STOPS = (1e-4, 1 / 4096, 1 / 2048, 1 / 1024, 1 / 255), (1e-4, 1e-3, 1 / 512)
_FAST, _FASTEST = {"arithmetic": "fast"}, {"arithmetic": "fast", "projection_precision": "float32"}
_FASTEST_STOP = 1e-3

_ABLATIONS: tuple[dict[str, Any], ...] = (
    {"alpha_cutoff": 1 / 255},
    {"alpha_cutoff": math.exp(-4.5)},
    {"transmittance_stop": 1e-4},
    {"transmittance_stop": 1 / 256},
    {"opacity_ceiling": 0.99},
    {"stop_rule": "exclusive", "transmittance_stop": 1e-4, "order": "centre"},
    {"lowpass": "none"},
    {"projection_precision": "float32"},
    {"arithmetic": "fast"},
    {"arithmetic": "approximate"},
    {"blend_precision": "float16"},
)
"""changes of `EXACT`, one constant at a time"""

_TEXTS = {math.exp(-4.5): "3 sigma"} | {  # cut-off of an opaque splat at 3 sigma
    above / below: f"{above}/{below}"
    for above, below in (
        (1, 255), (2, 255), (4, 255), (1, 256), (1, 512), (1, 1024), (1, 2048), (1, 4096),
    )
}  # fmt: skip

PRESET, ABLATION, COMBINED, MARKER = "preset", "alone", "together", "marker"
"""settings that are not fields of Quality; used in keys of results"""
SETTINGS = (PRESET, ABLATION, *_VALUES, MARKER, COMBINED)
"""values of --settings"""


@dataclass(frozen=True)
class Point:
    """A quality to measure."""

    setting: str
    """name in `SETTINGS`, or `base`"""
    value: str
    """value as text"""
    quality: Quality

    def key(self) -> dict:
        """Key of a result without scene and device, with the differences of the quality from `BASE`."""
        changes = _changes(asdict(self.quality), asdict(BASE))
        return {"setting": self.setting, "value": self.value, "quality": changes}


BASE_POINT = Point("base", "base", BASE)


def quality_of(changes: dict) -> Quality:
    """Quality of a result's key."""
    marker = replace(BASE.marker, **changes.get("marker", {}))
    return BASE.with_(**changes | {"marker": marker})


def _changes(values: dict, defaults: dict) -> dict:
    """Values that differ, also in nested dicts."""
    return {
        name: _changes(value, defaults[name]) if isinstance(value, dict) else value
        for name, value in values.items()
        if value != defaults[name]
    }


def setting_names(names: Iterable[str]) -> tuple[str, ...]:
    """Distinct names of settings; all if none is given.

    Raises:
        InputError: an unknown setting.
    """
    names = tuple(dict.fromkeys(names)) or SETTINGS
    for name in names:
        if name not in SETTINGS:
            raise InputError(unknown("setting", name, SETTINGS))
    return names


def points(
    settings: Iterable[str], on_marker: bool, quick: bool = False, every_value: bool = True
) -> list[Point]:
    """Distinct points for one kind of scene, starting with the most informative.

    The base is first: its error, and its time relative to itself, which shows the noise.

    Args:
        every_value: vary each setting; False: only presets and marker qualities.
    """
    settings = tuple(settings)
    chosen = [BASE_POINT]
    if PRESET in settings:
        # surfel has the same constants as gsplat
        chosen += [Point(PRESET, name, preset(name)) for name in PRESETS if name != "surfel"]
    if ABLATION in settings and not on_marker:
        chosen.append(Point(ABLATION, "exact", EXACT))
        chosen += map(ablation, _ABLATIONS[:6] if quick else _ABLATIONS)
    if MARKER in settings and on_marker:
        chosen += _marker_points(quick)
    for setting, values in (_QUICK_VALUES if quick else _VALUES).items():
        if every_value and setting in settings and setting != "ellipsoid":
            chosen += [_variation(setting, value) for value in values]
    if COMBINED in settings and not on_marker:
        chosen += _combinations(quick)
    return list({(point.setting, point.value): point for point in chosen}.values())


def ellipsoid_points(settings: Iterable[str]) -> list[Point]:
    """Points of scenes with 3D Gaussians: the base, and the values of `ellipsoid` in exact frames."""
    values = ELLIPSOID if "ellipsoid" in settings else ()
    return [BASE_POINT, *(Point("ellipsoid", value, EXACT.with_(ellipsoid=value)) for value in values)]


def preset(name: str) -> Quality:
    """A preset with the marker quality of `BASE`."""
    return PRESETS[name].with_(marker=BASE.marker)


def ablation(changes: dict[str, Any]) -> Point:
    """Point with one constant of the quality `EXACT` changed."""
    setting, value = next(iter(changes.items()))
    return Point(ABLATION, f"{setting} {value_text(value)}", EXACT.with_(**changes))


def _variation(setting: str, value: Any) -> Point:
    """Point with one value of `BASE` changed."""
    changes = {setting: value}
    if value == "exclusive":
        changes["order"] = "centre"  # required by the exclusive stop
    return Point(setting, value_text(value), BASE.with_(**changes))


def value_text(value: Any) -> str:
    """Value as text, with common fractions such as 1/255."""
    return _TEXTS.get(value) or (f"{value:g}" if isinstance(value, float) else str(value))


def marker_text(quality: MarkerQuality) -> str:
    """Marker quality as text, e.g. "paper L3 x1"."""
    text = {
        "paper": f"paper L{quality.levels} x{quality.density}",
        "fitted": f"fitted {quality.template}",
    }.get(quality.mixture, quality.mixture)
    return text if quality.growth is None else f"{text} growth {quality.growth:g}"


def _marker_points(quick: bool) -> Iterator[Point]:
    """Points of all marker qualities, with the base and with `SHARP`."""
    for quality in (BASE.marker, *(_QUICK_MARKER_QUALITIES if quick else _MARKER_QUALITIES)):
        text = marker_text(quality)
        if quality != BASE.marker:
            yield Point(MARKER, text, BASE.with_(marker=quality))
        if quality.mixture != "exact":  # box splats are always antialiased
            yield Point(MARKER, f"{text}, 3 x 3", BASE.with_(marker=quality, **SHARP))


def _combinations(quick: bool) -> Iterator[Point]:
    """Combinations of cut-off and stop, in precise and fast arithmetic, some with a float32 projection."""
    cutoffs = _COMBINED_CUTOFFS[1::2] if quick else _COMBINED_CUTOFFS
    for more, text in (({}, ""), (_FAST, ", fast"), (_FASTEST, ", fast, float32 projection")):
        stops = (_FASTEST_STOP,) if quick or more is _FASTEST else _COMBINED_STOPS
        for cutoff in cutoffs:
            for stop in stops:
                if not more and (cutoff == BASE.alpha_cutoff or stop == BASE.transmittance_stop):
                    continue  # a single setting
                changes = {"alpha_cutoff": cutoff, "transmittance_stop": stop, **more}
                value = f"cutoff {value_text(cutoff)}, stop {value_text(stop)}{text}"
                yield Point(COMBINED, value, BASE.with_(**changes))
