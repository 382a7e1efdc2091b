"""The tables [sensor], [fog] and [background] of a scene file, in and out."""

import math
import os
from pathlib import Path

from fidsplat.errors import InputError
from fidsplat.scenes.parts import SceneParts
from fidsplat.scenes.table import Table
from fidsplat.sensor import Sensor
from fidsplat.surroundings import Fog, Gradient, Panorama

SENSOR = ("exposure", "vignetting", "full_well", "read_noise", "seed", "gain", "response", "bits")
FOG = ("density", "color")
BACKGROUND = ("top", "bottom", "up", "image")


def read_sensor(top: Table) -> Sensor | None:
    """The sensor of a scene file; None if it has none. Raises InputError, naming the key."""
    if "sensor" not in top:
        return None
    table = top.table("sensor", SENSOR)
    with table.at():
        return Sensor(
            exposure=table.number("exposure", 1.0),
            vignetting=table.any_numbers("vignetting", ()),
            full_well=table.number("full_well", math.inf, infinite=True),
            read_noise=table.number("read_noise", 0.0),
            seed=table.whole("seed", 0),
            gain=table.number("gain", 1.0),
            response=_response(table),
            bits=table.whole("bits", None),
        )


def _response(table: Table) -> str | float | tuple[float, ...]:
    kind = table.kind("response")
    if kind is list:
        return table.any_numbers("response", ())
    return table.text("response", "linear") if kind in (str, None) else table.number("response")


def read_fog(top: Table) -> Fog | None:
    """The fog of a scene file; None if it has none. Raises InputError, naming the key."""
    if "fog" not in top:
        return None
    table = top.table("fog", FOG)
    with table.at():
        return Fog(table.number("density"), table.numbers("color", 3, Fog.color))


def read_background(top: Table, folder: Path) -> Gradient | Panorama | None:
    """The background of a scene file's own table; None if it has none. Raises InputError, naming the key."""
    if "background" not in top:
        return None
    table = top.table("background", BACKGROUND)
    if "image" in table:
        for key in ("top", "bottom", "up"):
            if key in table:
                raise table.error(key, "and image exclude each other")
        name = table.text("image")
        with table.at("image"):
            return Panorama.load(folder / name)
    with table.at():
        return Gradient(
            table.numbers("top", 3), table.numbers("bottom", 3), table.numbers("up", 3, Gradient.up)
        )


def imaging_tables(scene: SceneParts, folder: Path) -> dict[str, dict]:
    """Tables by name that say a scene's sensor, fog and background. Raises InputError for a panorama that
    came from no file.
    """
    tables: dict[str, dict] = {}
    around = scene.background
    if isinstance(around, Gradient):
        tables["background"] = {name: list(getattr(around, name)) for name in ("top", "bottom", "up")}
    elif isinstance(around, Panorama):
        if around.file is None:
            raise InputError(
                "the background is a panorama that came from no file, and a scene file names one; write it "
                "as a picture and use Panorama.load"
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
