"""Sensor, fog and background in scene files: the tables [sensor], [fog] and [background]."""

import os
from pathlib import Path
from typing import TypeVar

from fidsplat.capture.environment import Fog, Gradient, Panorama
from fidsplat.capture.sensor import Sensor
from fidsplat.scenes.parts import SceneParts
from fidsplat.scenes.table import Table, names_of
from fidsplat.util.errors import InputError

BACKGROUND = (*names_of(Gradient), "image")


_Part = TypeVar("_Part", Sensor, Fog)


def read_part(top: Table, name: str, kind: type[_Part]) -> _Part | None:
    """The sensor or the fog of a scene file; None if it has none. Raises InputError, naming the key."""
    if name not in top:
        return None
    table = top.table(name, names_of(kind))
    with table.at():
        return kind(**table.values(kind))


def read_background(top: Table, folder: Path) -> Gradient | Panorama | None:
    """The background of a scene file's own table; None if it has none. Raises InputError, naming the key."""
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
    around = scene.background
    if isinstance(around, Gradient):
        tables["background"] = {name: list(getattr(around, name)) for name in names_of(Gradient)}
    elif isinstance(around, Panorama):
        if around.file is None:
            raise InputError(
                "a background panorama must be loaded from a file to be saved, got an array; write it as an "
                "image and use Panorama.load"
            )
        tables["background"] = {"image": os.path.relpath(around.file, folder)}
    if scene.fog is not None:
        tables["fog"] = {"density": float(scene.fog.density), "color": list(scene.fog.color)}
    if scene.sensor is not None:
        changes = scene.sensor.changes()
        tables["sensor"] = {
            name: list(value) if isinstance(value, tuple) else value for name, value in changes.items()
        }
    return tables
