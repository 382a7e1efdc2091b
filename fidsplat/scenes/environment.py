"""Tables [sensor], [fog], [background] and [quality] of scene files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, TypeVar

from fidsplat.capture.environment import Fog, Gradient, Panorama
from fidsplat.capture.quality import PRESETS, MarkerQuality, Quality, setting_types
from fidsplat.capture.sensor import Sensor
from fidsplat.scenes.parts import SceneParts
from fidsplat.scenes.table import Table, names_of
from fidsplat.util.errors import InputError

BACKGROUND = (*names_of(Gradient), "image")


_Part = TypeVar("_Part", Sensor, Fog)


def read_part(top: Table, name: str, kind: type[_Part]) -> _Part | None:
    """Read the table [sensor] or [fog] of a scene file; None without it. Raises InputError with the key."""
    if name not in top:
        return None
    table = top.table(name, names_of(kind))
    with table.at():
        return kind(**table.values(kind))


def read_background(top: Table, folder: Path) -> Gradient | Panorama | None:
    """The background of the table [background]; None without it. Raises InputError with the key."""
    if "background" not in top:
        return None
    table = top.table("background", BACKGROUND)
    if "image" in table:
        for key in names_of(Gradient):
            if key in table:
                raise table.error(key, "and image exclude each other")
        name = table.text("image")
        with table.at("image"):
            return Panorama.load(folder / name)
    with table.at():
        return Gradient(**table.values(Gradient))


def environment_tables(scene: SceneParts, folder: Path) -> dict[str, dict]:
    """Tables of a scene's sensor, fog and background, by name.

    Raises InputError for a panorama that was not loaded from a file.
    """
    tables: dict[str, dict] = {}
    background = scene.background
    if isinstance(background, Gradient):
        tables["background"] = {name: list(getattr(background, name)) for name in names_of(Gradient)}
    elif isinstance(background, Panorama):
        if background.file is None:
            raise InputError(
                "a background panorama must be loaded from a file to be saved, got an array; write it as an "
                "image and use Panorama.load"
            )
        tables["background"] = {"image": os.path.relpath(background.file, folder)}
    if scene.fog is not None:
        tables["fog"] = {"density": float(scene.fog.density), "color": list(scene.fog.color)}
    if scene.sensor is not None:
        changes = scene.sensor.non_default()
        tables["sensor"] = {
            name: list(value) if isinstance(value, tuple) else value for name, value in changes.items()
        }
    return tables


def read_quality(top: Table, render: Table) -> Quality | str | None:
    """Quality of a scene file: the table [quality], or the key `quality` of [render]."""
    # samples, lowpass and first_hit are keys of [render] in files without [quality]
    older = {"samples": render.whole, "lowpass": render.text, "first_hit": render.number}
    keys = [key for key in ("quality", *older) if key in render]
    if "quality" not in top:
        words = [f"{key}={older[key](key)}" if key in older else render.text(key) for key in keys]
        text = ",".join(words) or None
        with render.at("quality"):
            Quality.of(text)
        return text
    if keys:
        raise render.error(keys[0], "and the table [quality] exclude each other; write it there")
    table = top.table("quality", ("preset", *setting_types(Quality), "marker"))
    with table.at("preset"):
        plain = Quality.named(table.text("preset", "standard"))
    changes = table.values(Quality)
    if "marker" in table:
        changes["marker"] = table.table("marker", names_of(MarkerQuality)).values(MarkerQuality)
    with table.at():
        return plain.with_(**changes)


def quality_tables(quality: Quality | str | None) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Keys of [render] for a quality, and additional tables by name."""
    if quality is None:
        return {}, {}
    if isinstance(quality, str):
        return {"quality": quality}, {}
    for name, plain in PRESETS.items():
        if plain == quality:
            return {"quality": name}, {}
    plain = PRESETS["standard"]
    tables = {"quality": {"preset": "standard"} | _changes(quality, plain)}
    if of_markers := _changes(quality.marker, plain.marker):
        tables["quality.marker"] = of_markers
    return {}, tables


def _changes(settings: Quality | MarkerQuality, plain: Quality | MarkerQuality) -> dict[str, Any]:
    """Settings that differ from the settings of `plain`."""
    pairs = {name: (getattr(settings, name), getattr(plain, name)) for name in setting_types(type(settings))}
    return {name: value for name, (value, before) in pairs.items() if value != before}


def marker_settings(quality: MarkerQuality, scene: Quality | str | None) -> dict[str, Any]:
    """Settings of a marker that differ from the scene's quality."""
    changes = _changes(quality, Quality.of(scene).marker)
    if "growth" in changes and quality.growth is None:  # TOML has no None, the default of the mixture
        from fidsplat.markers.mixture import fitted_growth

        changes["growth"] = fitted_growth() if quality.mixture == "fitted" else 0.0
    relevant = {"fitted": ("growth", "template"), "paper": ("levels", "density", "growth"), "facets": ()}
    names = relevant.get(quality.mixture, ("template",))
    return {"mixture": quality.mixture} | {name: changes[name] for name in names if name in changes}
