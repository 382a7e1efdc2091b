"""Lights of a scene, and the reflection model of markers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from fidsplat.capture.sensor import GAMMA_RANGE
from fidsplat.scenes.table import Table, names_of
from fidsplat.util.arguments import (
    LARGEST,
    as_float,
    changes_of,
    invalid,
    number,
    parse_settings,
    python_scalars,
    three_numbers,
    whole_number,
)
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.response import to_colors

SOURCES = ("scene", "lights")
VIEWS = ("any", "camera")
MAX_SAMPLES = 1024
PANORAMAS_PER_SIDE = (1, 2, 3, 5, 9, 17)
"""allowed numbers of panoramas along a side; each grid contains the points of the coarser ones"""


@dataclass(frozen=True)
class Lighting:
    """Reflection model of a marker: its colours in the light of the scene.

    The reflectance of a splat of colour c is `ink` + (`paper` - `ink`) c, with c in linear light. Matte
    paper of reflectance 1 under radiance L from all directions has the radiance L. Raises InputError for a
    value out of range.
    """

    source: str = "scene"
    """"scene": light from splats, background and lights of the scene; "lights": from its lights only"""
    paper: float = 0.85
    """reflectance of white, 0 to 1"""
    ink: float = 0.05
    """reflectance of black, 0 to 1, at most that of paper"""
    roughness: float | None = None
    """0.1 to 1: a glossy surface (GGX, alpha = roughness squared); None: matte"""
    reflectance: float = 0.04
    """Fresnel reflectance of the glossy surface at normal incidence, 0 to 1"""
    view: str = "any"
    """gloss "any": spherical harmonics of degree 3, from every direction; "camera": exact at the scene's
    camera"""
    exposure: float = 1.0
    """factor of the light, at least 0"""
    response: str | float = "srgb"
    """response of the scene's colours to light: "srgb", "linear", or a gamma as in `Sensor.response`; values
    above 1 are kept"""
    ambient: tuple[float, float, float] | None = None
    """linear RGB radiance of the directions without splats; None: the scene's background"""
    rows: int = 64
    """height in pixels of the panoramas by which light is measured, 8 to 1024"""
    panoramas: int = 5
    """maximum number of panoramas along a side of the marker: 1, 2, 3, 5, 9 or 17"""
    step: float = 0.04
    """largest relative error of a rectangle's radiance, above which the rectangle is split; and of light that
    is interpolated between panoramas, relative to the marker's largest, above which more are rendered"""
    clearance: float | None = None
    """distance in front of the marker [m] within which splats do not occlude light; None: size / 20"""

    def __post_init__(self) -> None:
        python_scalars(self)
        for name, known in (("source", SOURCES), ("view", VIEWS)):
            value = getattr(self, name)
            if value not in known:
                raise InputError(unknown(f"{name} of a marker's light", str(value), known))
        for name, low, high in (
            ("paper", 0, 1),
            ("ink", 0, self.paper),
            ("reflectance", 0, 1),
            ("exposure", 0, LARGEST),
            ("step", 1e-4, 1),
            *([("roughness", 0.1, 1)] if self.roughness is not None else []),
            *([("clearance", 0, LARGEST)] if self.clearance is not None else []),
        ):
            number(f"light: {name}", getattr(self, name), f"a number from {low:g} to {high:g}", low, high)
        whole_number("light: rows", self.rows, 8, 1024)
        if type(self.panoramas) is not int or self.panoramas not in PANORAMAS_PER_SIDE:
            raise invalid("light: panoramas", ", ".join(map(str, PANORAMAS_PER_SIDE)), self.panoramas)
        if self.ambient is not None:
            object.__setattr__(self, "ambient", _radiance("light: ambient", self.ambient))
        if self.response not in ("srgb", "linear") or isinstance(self.response, bool):
            requirement = '"srgb", "linear" or a gamma from {:g} to {:g}'.format(*GAMMA_RANGE)
            number("light: response", self.response, requirement, *GAMMA_RANGE)

    def encode(self, radiance: np.ndarray) -> np.ndarray:
        """Convert reflected radiance to colours in display space."""
        with np.errstate(over="ignore"):
            return np.minimum(to_colors(self.exposure * radiance, self.response), LARGEST)

    @staticmethod
    def of(value: Any) -> Lighting | None:
        """Convert a text such as "lights,roughness=0.3" to a Lighting; a Lighting and None stay the same.
        Raises InputError for anything else."""
        if value is None or isinstance(value, Lighting):
            return value
        if isinstance(value, str):
            parts = (part if "=" in part else f"source={part}" for part in value.split(","))
            return Lighting(**parse_settings("light", Lighting, parts))
        raise invalid("a marker's light", "'scene', 'lights', an fs.Lighting or None", value)


@dataclass(frozen=True, kw_only=True)
class Light:
    """Base of the lights of a scene, `Sun`, `PointLight` and `SpotLight`.

    Lights illuminate markers with a `light`, not captured splats. Raises InputError for a value out of range.
    """

    kind: ClassVar[str]
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """linear RGB factors of the intensity, at least 0"""
    intensity: float = 1.0
    """irradiance of a surface that faces the light, for point and spot lights 1 m away on the axis"""
    samples: int = 32
    """number of points on the light from which shadows are rendered, 1 to 1024; more smooth soft shadows"""

    def __post_init__(self) -> None:
        python_scalars(self)
        self._number("intensity", 0, LARGEST)
        whole_number(f"{self.kind}: samples", self.samples, 1, MAX_SAMPLES)
        object.__setattr__(self, "color", _radiance(f"{self.kind}: color", self.color))
        for name in ("position", "direction"):
            if name in self.__dataclass_fields__:
                vector = three_numbers(f"{self.kind}: {name}", getattr(self, name))
                if name == "direction" and not 0 < np.linalg.norm(vector) < math.inf:
                    raise invalid(f"{self.kind}: direction", "three numbers, not all 0", vector)
                object.__setattr__(self, name, vector)

    def _number(self, name: str, low: float, high: float) -> None:
        requirement = f"a number from {low:g} to {high:g}" + " radians" * (name in _ANGLES)
        number(f"{self.kind}: {name}", getattr(self, name), requirement, low, high)

    @property
    def power(self) -> np.ndarray:
        """Intensity in each channel, (3,)."""
        return self.intensity * np.array(self.color)


@dataclass(frozen=True, kw_only=True)
class Sun(Light):
    """A light at infinity."""

    kind: ClassVar[str] = "sun"
    direction: tuple[float, float, float]
    """direction of propagation of the light in the world, of any length"""
    angle: float = math.radians(0.53)
    """angular diameter in radians, 0 to 3"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._number("angle", 0, 3)


@dataclass(frozen=True, kw_only=True)
class PointLight(Light):
    """A sphere that radiates equally in all directions."""

    kind: ClassVar[str] = "point"
    position: tuple[float, float, float]
    """centre in the world [m]"""
    radius: float = 0.0
    """radius [m]"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._number("radius", 0, LARGEST)


@dataclass(frozen=True, kw_only=True)
class SpotLight(PointLight):
    """A sphere whose light is limited to a cone."""

    kind: ClassVar[str] = "spot"
    direction: tuple[float, float, float]
    """axis of the cone in the world, of any length"""
    inner: float = 0.0
    """angle from the axis [rad] up to which the intensity is constant"""
    outer: float = math.radians(45)
    """angle from the axis [rad] from which the intensity is 0, above `inner`, at most pi / 2"""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._number("inner", 0, math.pi / 2)
        self._number("outer", 0, math.pi / 2)
        if not self.inner < self.outer:
            inner, outer = (f"{math.degrees(angle):g} degrees" for angle in (self.inner, self.outer))
            raise InputError(f"spot: outer must be above inner, {inner}, got {outer}")


LIGHTS: dict[str, type[Light]] = {kind.kind: kind for kind in (Sun, PointLight, SpotLight)}
_ANGLES = {"angle", "inner", "outer"}
"""fields in radians, whose keys in scene files are NAME_deg"""


def read_lights(top: Table) -> tuple[Light, ...]:
    """The lights of the tables [[lights]]. Raises InputError with the key."""
    lights = []
    every = {_key(name) for kind in LIGHTS.values() for name in names_of(kind)}
    for any_kind in top.tables("lights", ("kind", *sorted(every))):
        kind, table = any_kind.of_kind(LIGHTS, _key)
        with table.at():
            values = table.values(kind, _key)
            values |= {name: math.radians(values[name]) for name in _ANGLES & values.keys()}
            lights.append(kind(**values))
    return tuple(lights)


def light_tables(lights: tuple[Light, ...]) -> Iterator[dict[str, Any]]:
    """Tables [[lights]] of lights."""
    for light in lights:
        changes = changes_of(light)
        changes |= {name: math.degrees(changes[name]) for name in _ANGLES & changes.keys()}
        yield {"kind": light.kind} | {_key(name): value for name, value in changes.items()}


def read_lighting(marker: Table) -> Lighting | None:
    """Parse the key `light` of a [[markers]] table: the name of a source, or a table."""
    if "light" not in marker:
        return None
    if marker.is_text("light"):
        with marker.at("light"):
            return Lighting.of(marker.text("light"))
    table = marker.table("light", names_of(Lighting))
    with table.at():
        return Lighting(**table.values(Lighting))


def lighting_value(light: Lighting | None) -> dict[str, Any]:
    """The key `light` of a [[markers]] table; empty without light."""
    if light is None:
        return {}
    changes = changes_of(light)
    return {"light": light.source if set(changes) <= {"source"} else changes}


def _key(name: str) -> str:
    return f"{name}_deg" if name in _ANGLES else name


def _radiance(name: str, value: Any) -> tuple[float, float, float]:
    """Validated RGB of at least 0."""
    color = three_numbers(name, value)
    if min(map(as_float, color)) < 0:
        raise invalid(name, "three numbers of at least 0", value)
    return color
