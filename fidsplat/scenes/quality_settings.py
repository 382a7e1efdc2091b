"""Quality settings in scene files: the table [quality], and some keys of [render]."""

from __future__ import annotations

from typing import Any

from fidsplat.capture.quality import PRESETS, MarkerQuality, Quality, setting_types
from fidsplat.scenes.table import Table, names_of

_RENDER_KEYS = ("samples", "lowpass", "first_hit")


def read_quality(top: Table, render: Table) -> Quality | str | None:
    """Quality of a scene file: the table [quality], or the preset and keys of [render]."""
    given = [key for key in ("quality", *_RENDER_KEYS) if key in render]
    if "quality" in top:
        if given:
            raise render.error(given[0], "and the table [quality] exclude each other; write it there")
        table = top.table("quality", ("preset", *setting_types(Quality), "marker"))
        with table.at("preset"):
            plain = Quality.named(table.text("preset", "standard"))
        changes = table.values(Quality)
        if "marker" in table:
            changes["marker"] = table.table("marker", names_of(MarkerQuality)).values(MarkerQuality)
        with table.at():
            return plain.with_(**changes)
    text = render.text("quality", None)
    with render.at("quality"):
        quality = Quality.of(text)
    readers = {"samples": render.whole, "lowpass": render.text, "first_hit": render.number}
    for key in _RENDER_KEYS:
        if key in render:
            with render.at(key):
                quality = quality.with_(**{key: readers[key](key)})
    return quality if set(given) - {"quality"} else text


def quality_tables(quality: Quality | str | None) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Keys of [render] for a quality, and additional tables by name."""
    if quality is None:
        return {}, {}
    if isinstance(quality, str):
        return {"quality": quality}, {}
    own = {key: getattr(quality, key) for key in _RENDER_KEYS}
    for name, preset in PRESETS.items():
        if preset.with_(**own) == quality:
            return {"quality": name} | _changes(quality, preset), {}
    plain = PRESETS["standard"]
    tables = {"quality": {"preset": "standard"} | _changes(quality, plain)}
    if of_markers := _changes(quality.marker, plain.marker):
        tables["quality.marker"] = of_markers
    return {}, tables


def _changes(given: Quality | MarkerQuality, plain: Quality | MarkerQuality) -> dict[str, Any]:
    """Settings in which two differ, with the values of the first."""
    pairs = {name: (getattr(given, name), getattr(plain, name)) for name in setting_types(type(given))}
    return {name: value for name, (value, before) in pairs.items() if value != before}


def marker_settings(quality: MarkerQuality, scene: Quality | str | None) -> dict[str, Any]:
    """Settings of a marker that differ from the scene's quality."""
    changes = _changes(quality, Quality.of(scene).marker)
    if (
        "growth" in changes and quality.growth is None
    ):  # a file cannot express None, the default of the mixture
        from fidsplat.markers.mixture import fitted_growth

        changes["growth"] = fitted_growth() if quality.mixture == "fitted" else 0.0
    relevant = {"fitted": ("growth", "template"), "paper": ("levels", "density", "growth"), "facets": ()}
    names = relevant.get(quality.mixture, ("template",))
    return {"mixture": quality.mixture} | {name: changes[name] for name in names if name in changes}
