"""LiDAR model: beam pattern, returns, noise and detection."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fidsplat.cameras import Camera, RayTable
from fidsplat.cameras.pinhole import MAX_SIZE
from fidsplat.util.arguments import (
    array_of,
    instance,
    invalid,
    items,
    number,
    python_scalars,
    real_array,
    whole_number,
)
from fidsplat.util.directions import disk, perpendicular, unit
from fidsplat.util.errors import InputError, unknown

RETURNS = ("first", "strongest", "last")
MAX_BEAMS = 2**22


@dataclass(frozen=True)
class Spinning:
    """Lasers on a rotor: a scan is one rotation about z, clockwise seen from above, from azimuth pi
    (behind)."""

    elevations: tuple[float, ...]
    """radians above the xy plane, one for each laser (ring)"""
    columns: int = 1024
    """firings per rotation"""
    azimuths: tuple[float, ...] = ()
    """radians, counterclockwise azimuth offset of each laser; empty: all 0"""

    def __post_init__(self) -> None:
        limit = math.radians(88)
        for name, maximum in (("elevations", limit), ("azimuths", math.pi)):
            angles = array_of(name, getattr(self, name), "numbers in radians", "fiu").astype(np.float64)
            if angles.ndim != 1 or not (np.abs(angles) <= maximum).all():
                remedy = "np.radians converts degrees"
                raise invalid(name, f"numbers up to {maximum:.4g} rad", getattr(self, name), remedy)
            object.__setattr__(self, name, tuple(angles.tolist()))
        whole_number("columns", self.columns, 1, MAX_SIZE)
        if not 1 <= len(self.elevations) <= MAX_SIZE:
            raise invalid("elevations", f"1 to {MAX_SIZE} numbers", self.elevations)
        if len(self.azimuths) not in (0, len(self.elevations)):
            raise InputError(
                f"azimuths must have one number for each of {len(self.elevations)} elevations, got "
                f"{len(self.azimuths)}"
            )

    @property
    def rings(self) -> int:
        """Number of lasers."""
        return len(self.elevations)

    @property
    def beams(self) -> int:
        """Number of beams per scan."""
        return self.columns * self.rings

    def directions(self, start: float, duration: float) -> np.ndarray:
        """(columns x rings, 3) unit directions in the order of firing, the same for every scan."""
        firing_azimuth = math.pi - 2 * math.pi * (np.arange(self.columns) + 0.5) / self.columns
        azimuth = firing_azimuth[:, None] + (np.array(self.azimuths) if self.azimuths else 0.0)
        elevation = np.broadcast_to(self.elevations, (self.columns, self.rings))
        cosine = np.cos(elevation)
        rays = (cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation))
        return np.stack(rays, 2).reshape(-1, 3)

    def fractions(self) -> np.ndarray:
        """(beams,) time of each beam as a fraction of the scan; the lasers of a column fire together."""
        return np.repeat((np.arange(self.columns) + 0.5) / self.columns, self.rings)

    def ring_of(self) -> np.ndarray:
        """(beams,) index of the laser of each beam."""
        return np.tile(np.arange(self.rings), self.columns)


@dataclass(frozen=True)
class Rosette:
    """One laser behind two rotating prisms (Risley prisms), around the x axis; each scan differs."""

    half_angle: float
    """radians between the x axis and the outermost beams"""
    rates: tuple[float, float]
    """angular velocities of the two prisms in radians per second"""
    points: int = 10_000
    """beams per scan"""

    def __post_init__(self) -> None:
        number("half_angle", self.half_angle, "an angle above 0, at most 1.4 rad", 1e-6, 1.4)
        rates = real_array("rates", self.rates, "two numbers in rad/s, one for each prism")
        if rates.shape != (2,) or not np.isfinite(rates).all():
            raise invalid("rates", "two numbers in rad/s, one for each prism", self.rates)
        object.__setattr__(self, "rates", tuple(rates.tolist()))
        whole_number("points", self.points, 1, MAX_BEAMS)

    rings = 1

    @property
    def beams(self) -> int:
        """Number of beams per scan."""
        return self.points

    def directions(self, start: float, duration: float) -> np.ndarray:
        """(points, 3) unit directions in the order of firing, of a scan that starts at a time in seconds."""
        time = start + duration * self.fractions()
        first, second = (rate * time for rate in self.rates)
        left = self.half_angle / 2 * (np.cos(first) + np.cos(second))
        up = self.half_angle / 2 * (np.sin(first) + np.sin(second))
        angle = np.hypot(left, up)
        sinc = np.sinc(angle / np.pi)
        return np.stack([np.cos(angle), sinc * left, sinc * up], 1)

    def fractions(self) -> np.ndarray:
        """(points,) time of each beam as a fraction of the scan."""
        return (np.arange(self.points) + 0.5) / self.points

    def ring_of(self) -> np.ndarray:
        """(points,) zeros, the index of the only laser."""
        return np.zeros(self.points, np.int64)


Pattern: TypeAlias = Spinning | Rosette


@dataclass(frozen=True, eq=False)
class Lidar:
    """LiDAR sensor. Its frame has x forward, y left and z up, as in ROS."""

    pattern: Pattern
    """directions of the beams"""
    rate: float = 10.0
    """scans per second"""
    near: float = 0.5
    """metres, minimum range; nearer returns are omitted"""
    far: float = 100.0
    """metres, maximum range"""
    divergence: float = 2e-3
    """full angle of a beam in radians"""
    rays: int = 1
    """rays per beam, distributed over its cross-section; several returns require several rays"""
    returns: tuple[str, ...] = ("strongest",)
    """returns that are reported for each beam, from first, strongest and last; a return that equals an
    earlier one in this list is empty"""
    separation: float = 1.0
    """metres; surfaces of a beam that are closer in range than this are one return"""
    opacity: float = 0.5
    """accumulated opacity at which a ray ends: 0.5 is the median surface, lower values are nearer surfaces"""
    noise: float = 0.0
    """standard deviation of ranges in metres"""
    noise_growth: float = 0.0
    """increase of the standard deviation per metre of range"""
    detection_range: float = math.inf
    """metres at which a surface of 10 % reflectivity, facing the sensor, is detected with a probability of
    90 %. The signal is proportional to reflectivity, cosine of incidence and inverse square of the range"""
    dropouts: float = 0.0
    """fraction of returns that are dropped at random, 0 to 1"""
    reflectivity: dict[int, float] = field(default_factory=dict)
    """label -> reflectivity of its splats, 0 or more; by default the luminance of a splat's colour in linear
    light"""
    bands: int = 32
    """number of poses per scan if anything moves, at most the number of columns; a beam is rendered at a pose
    up to duration / (2 bands) earlier or later"""
    seed: int = 0
    """seed of noise and detection, 0 to 2^32 - 1"""
    source: str = ""
    """publication with the values of a preset"""

    def __post_init__(self) -> None:
        python_scalars(self)
        instance("pattern", self.pattern, Pattern, "a Spinning or a Rosette")  # type: ignore[arg-type]
        for name, low, high, requirement in (
            ("rate", 1e-3, 1e6, "scans per second, above 0"),
            ("near", 1e-3, 1e9, "metres, above 0"),
            ("far", self.near, 1e9, "metres, from near to 1e9"),
            ("divergence", 1e-9, 0.5, "radians, above 0"),
            ("separation", 0.0, 1e9, "metres, at least 0"),
            ("opacity", 1e-3, 0.999, "a fraction from 0.001 to 0.999"),
            ("noise", 0.0, 1e9, "metres, at least 0"),
            ("noise_growth", 0.0, 1.0, "a number from 0 to 1"),
            ("dropouts", 0.0, 1.0, "a fraction from 0 to 1"),
        ):
            number(f"lidar {name}", getattr(self, name), requirement, low, high)
        if not isinstance(self.detection_range, int | float) or not self.detection_range > 0:
            raise invalid("lidar detection_range", "metres, above 0", self.detection_range)
        whole_number("lidar rays", self.rays, 1, 256)
        whole_number("lidar bands", self.bands, 1, MAX_SIZE)
        whole_number("lidar seed", self.seed, 0, 2**32 - 1)
        if isinstance(self.returns, str):
            object.__setattr__(self, "returns", (self.returns,))
        kinds = items("lidar returns", self.returns, str, "some of first, strongest, last")
        for kind in kinds:
            if kind not in RETURNS:
                raise InputError(unknown("return of a lidar", kind, RETURNS))
        if not kinds or len(set(kinds)) < len(kinds):
            raise invalid("lidar returns", "one or more of first, strongest, last, each once", self.returns)
        if len(kinds) > 1 and self.rays == 1:
            raise InputError(
                "lidar rays must be at least 2 for several returns, got 1; give for example rays=4"
            )
        object.__setattr__(self, "returns", kinds)
        instance("lidar reflectivity", self.reflectivity, dict, "a dict of numbers by label")
        for label, value in self.reflectivity.items():
            whole_number("a label of lidar reflectivity", label, -(2**31), 2**31 - 1)
            number(f"lidar reflectivity of label {label}", value, "a number of at least 0", 0.0, 1e9)
        if self.pattern.beams * self.rays > MAX_BEAMS or (
            isinstance(self.pattern, Spinning) and self.pattern.rings * self.rays > MAX_SIZE
        ):
            raise InputError(
                f"a scan of a lidar must have at most {MAX_BEAMS:,} rays, got {self.pattern.beams:,} beams "
                f"of {self.rays} rays each"
            )

    @staticmethod
    def preset(name: str, **changes: Any) -> Lidar:
        """A sensor by name: vlp-16, os1-64 or livox-mid-40. changes: values of other fields."""
        all_presets = presets()
        if not isinstance(name, str) or name.lower() not in all_presets:
            raise InputError(unknown("lidar", name, all_presets))
        for change in changes:
            if change not in Lidar.__dataclass_fields__:
                raise InputError(unknown("field of a lidar", change, Lidar.__dataclass_fields__))
        preset = all_presets[name.lower()]
        return replace(preset, **changes) if changes else preset

    @property
    def duration(self) -> float:
        """Duration of a scan in seconds."""
        return 1 / self.rate

    def rows_per_band(self, moving: bool) -> int:
        """Rows of the ray table that share a pose."""
        height = self.camera(0.0, moving).height
        return height if not moving else -(-height // self.bands)

    def camera(self, start: float = 0.0, moving: bool = False) -> Camera:
        """Camera in the lidar's frame whose pixels are the rays of a scan that starts at a time in seconds.
        Rows are in the order of firing."""
        return self._rays(start, moving)[0]

    def pixels(self, start: float = 0.0, moving: bool = False) -> np.ndarray:
        """(beams, rays) int: index of each ray's pixel in the image of `camera`, in row-major order."""
        return self._rays(start, moving)[1]

    def directions(self, start: float = 0.0) -> np.ndarray:
        """(beams, 3) unit directions of a scan that starts at a time in seconds, in the order of firing,
        rounded to float32 like the rays."""
        return self._rays(start, False)[2]

    def _rays(self, start: float, moving: bool) -> tuple[Camera, np.ndarray, np.ndarray]:
        return _rays(self, start if isinstance(self.pattern, Rosette) else 0.0, moving)


@lru_cache(maxsize=8)
def _rays(lidar: Lidar, start: float, moving: bool) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Camera, pixels and directions of a scan, as returned by the methods of `Lidar`."""
    pattern, n = lidar.pattern, lidar.rays
    beams = pattern.directions(start, lidar.duration)
    rays = _divergent_rays(beams, lidar.divergence, n)
    if isinstance(pattern, Spinning):
        order = np.arange(len(rays)).reshape(pattern.columns, pattern.rings * n)
    else:
        bands = min(lidar.bands, len(beams)) if moving else 1
        edges = np.linspace(0, len(beams), bands + 1).astype(int)
        width = math.ceil(math.sqrt(np.diff(edges).max() * n))
        rows = -(-np.diff(edges).max() * n // width)
        order = np.concatenate(
            [_grid(rays, begin * n, end * n, rows, width) for begin, end in pairwise(edges)]
        )
    table = np.where(order[..., None] >= 0, rays[order], np.nan)
    pixels = np.empty(len(rays), np.int64)
    used = np.flatnonzero(order >= 0)
    pixels[order.reshape(-1)[used]] = used
    directions = beams.astype(np.float32).astype(np.float64)
    for array in (pixels, directions):
        array.flags.writeable = False
    lens, (height, width) = RayTable(table, lidar.divergence / math.sqrt(n)), table.shape[:2]
    camera = Camera(width, height, 1.0, 1.0, 0.0, 0.0, near=min(lidar.near, 0.05), far=lidar.far, lens=lens)
    return camera, pixels.reshape(-1, n), directions


def _grid(rays: np.ndarray, begin: int, end: int, rows: int, width: int) -> np.ndarray:
    """Indices (rows, width) of rays [begin, end), sorted into columns by horizontal direction and into rows
    by vertical direction; -1 in unused cells."""
    grid = np.full((width, rows), -1)
    columns = begin + np.argsort(rays[begin:end, 1], kind="stable")
    for column in range(width):
        in_column = columns[column * rows : (column + 1) * rows]
        grid[column, : len(in_column)] = in_column[np.argsort(rays[in_column, 2], kind="stable")]
    return grid.T


def _divergent_rays(beams: np.ndarray, divergence: float, count: int) -> np.ndarray:
    """(n x count, 3) directions of the rays of beams (n, 3), evenly distributed over the beam's disk by
    Vogel's spiral; the first ray is at its centre."""
    if count == 1:
        return beams
    return unit(beams[:, None] + divergence / 2 * (disk(count, 0) @ perpendicular(beams))).reshape(-1, 3)


@cache
def presets() -> dict[str, Lidar]:
    """Presets of lidars.json by name."""
    values_by_name = json.loads(Path(__file__).with_name("lidars.json").read_text("utf-8"))
    return {name: _parsed_preset(values) for name, values in values_by_name.items()}


def _parsed_preset(values: dict[str, Any]) -> Lidar:
    values = dict(values)
    if "half_angle_deg" in values:
        rates = [rate * 2 * math.pi / 60 for rate in values.pop("rates_rpm")]
        half_angle, points = math.radians(values.pop("half_angle_deg")), values.pop("points")
        pattern: Pattern = Rosette(half_angle, (rates[0], rates[1]), points)
    else:
        degrees = values.pop("elevations_deg")
        if isinstance(degrees, dict):
            degrees = np.linspace(degrees["from"], degrees["to"], degrees["count"])
        pattern = Spinning(tuple(np.radians(degrees)), values.pop("columns"))
    return Lidar(pattern, divergence=values.pop("divergence_mrad") / 1e3, **values)
