"""Shapes of a marker's sheet: parametric surfaces over the flat sheet, with unit tangents.

A surface maps positions (x, y) of the flat sheet, in metres from its centre, to positions in the marker's
frame. All surfaces but `Crumpled` are developable: the map preserves lengths, the centre stays at the origin,
and its tangent plane is the plane of the flat marker. The mean height of a crumpled sheet is 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import ClassVar, NamedTuple

import numpy as np

from fidsplat.util.arguments import (
    from_fields,
    instance,
    number,
    parse_settings,
    python_scalars,
    real_array,
    whole_number,
)
from fidsplat.util.errors import InputError, unknown

SHARPEST = 1e-4
"""minimum radius of curvature relative to the size of the sheet"""

WAVES = 7
"""number of plane waves of a crumpled sheet"""

CREASE = 0.2
"""width of the creases of a crumpled sheet, relative to their distance: 0 is a sharp edge"""

_POSITIVE = "a positive length in metres", 1e-9


class Frames(NamedTuple):
    """Points of a surface with orthonormal tangents, in the marker's frame."""

    points: np.ndarray
    """(n, 3) metres"""
    along_x: np.ndarray
    """(n, 3) unit tangent in the direction of the sheet's x"""
    along_y: np.ndarray
    """(n, 3) unit tangent in the direction of the sheet's y, perpendicular to `along_x`"""

    @property
    def normals(self) -> np.ndarray:
        """(n, 3) unit normals away from the viewer, as for splats."""
        return np.cross(self.along_x, self.along_y)


@dataclass(frozen=True)
class SheetShape:
    """Base of the shapes; `kind` is their name in scene files."""

    kind: ClassVar[str]
    limits: ClassVar[dict[str, tuple]] = {}
    """requirement, minimum and maximum of fields"""
    deviation: float | None = field(default=None, kw_only=True)
    """metres: maximum distance of the splats from the surface; None: size / 2500"""

    def __post_init__(self) -> None:
        python_scalars(self)
        for name in [entry.name for entry in fields(self) if entry.type == "float"]:
            number(f"shape: {name}", getattr(self, name), *self.limits.get(name, ()))
        if self.deviation is not None:
            number("shape: deviation", self.deviation, "a positive length in metres, or None", 1e-9)

    def fit(self, half: tuple[float, float]) -> None:
        """Raise InputError if a sheet with these half edges in metres does not fit on the surface."""

    def frames(self, xy: np.ndarray) -> Frames:
        """Points and tangents at positions (n, 2) of the sheet."""
        raise NotImplementedError

    def longest(self, deviation: float) -> float:
        """Maximum length [m] across the axis of a piece, so that samples measure its deviation [m]."""
        return math.inf

    @property
    def across(self) -> np.ndarray | None:
        """Direction (2,) of the largest curvature on the sheet; None for a surface of moderate slopes, which
        occludes itself only from the side."""
        return None


@dataclass(frozen=True)
class _Along(SheetShape):
    """Shape with an axis."""

    axis: str | tuple[float, ...] = field(default="y", kw_only=True)
    """direction on the sheet, "x", "y" or two numbers x, y, of the lines that stay straight; of a cone away
    from the apex"""

    def __post_init__(self) -> None:
        super().__post_init__()
        axis_of(self.axis)
        if not isinstance(self.axis, str):
            object.__setattr__(self, "axis", tuple(map(float, self.axis)))

    @property
    def across(self) -> np.ndarray:
        along = axis_of(self.axis)
        return np.array([along[1], -along[0]])

    def _extent(self, half: tuple[float, float]) -> float:
        """Half of the sheet's width across the axis."""
        return float(np.abs(self.across) @ half)


class _Profile(_Along):
    """Curve across the axis, extruded along it."""

    def _profile(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions across and away from the viewer, and tangent angles, at lengths s along the curve."""
        raise NotImplementedError

    def frames(self, xy: np.ndarray) -> Frames:
        xy = np.asarray(xy, np.float64)
        side, axis = np.array([*self.across, 0.0]), np.array([*axis_of(self.axis), 0.0])
        p, q, angle = self._profile(xy @ side[:2])
        viewing = np.array([0.0, 0.0, 1.0])
        points = p[:, None] * side + (xy @ axis[:2])[:, None] * axis + q[:, None] * viewing
        tangent = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * viewing
        return Frames(points, side[0] * tangent + axis[0] * axis, side[1] * tangent + axis[1] * axis)


@dataclass(frozen=True)
class Cylinder(_Profile):
    """Cylinder: a tag around a pipe or a bottle."""

    radius: float
    """metres; negative: on the inside of a pipe"""
    kind: ClassVar[str] = "cylinder"

    def fit(self, half: tuple[float, float]) -> None:
        width = 2 * self._extent(half)
        _require_radius(self.radius, width / (2 * math.pi), width)

    def _profile(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angle = s / self.radius
        return self.radius * np.sin(angle), 2 * self.radius * np.sin(angle / 2) ** 2, angle


@dataclass(frozen=True)
class BentSheet(_Profile):
    """Wavy sheet: its curvature is cos(2 pi s / length) / radius at the length s across the axis."""

    radius: float
    """metres: minimum radius of curvature; negative: the centre is the nearest to the wall, not the
    farthest"""
    length: float
    """metres along the sheet from one wave to the next"""
    kind: ClassVar[str] = "bent"
    limits: ClassVar[dict[str, tuple]] = {"length": _POSITIVE}

    def fit(self, half: tuple[float, float]) -> None:
        width = 2 * self._extent(half)
        _require_length(self.length, SHARPEST * width)
        # beyond, the tangent rotates by more than 90 degrees, and waves touch each other
        _require_radius(self.radius, max(self.length / math.pi**2, SHARPEST * width), width)

    def longest(self, deviation: float) -> float:
        # samples of more than one wave may all be at equal phases
        height = self.length**2 / (2 * math.pi**2 * abs(self.radius))
        return self.length if height > deviation / 4 else math.inf

    def _profile(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        wave, max_slope = 2 * math.pi / self.length, self.length / (2 * math.pi * self.radius)

        def angle(at: np.ndarray) -> np.ndarray:
            return max_slope * np.sin(wave * at)

        # complete waves do not rise; the quadrature is exact to rounding for half a wave
        at, weight = (np.polynomial.legendre.leggauss(24) + np.array([[1.0], [0.0]])) / 2
        waves = np.round(s / self.length)
        rest = s - waves * self.length
        angles = angle(rest[:, None] * at)
        forward = waves * self.length * (np.cos(angle(self.length / 2 * at)) @ weight)
        return forward + rest * (np.cos(angles) @ weight), rest * (np.sin(angles) @ weight), angle(s)


@dataclass(frozen=True)
class BoxEdge(_Profile):
    """Foil over the edge of a box: two planes at a right angle, joined by an arc."""

    radius: float
    """metres: radius of the arc; negative: foil in an inner corner"""
    offset: float = 0.0
    """metres from the centre of the marker to the edge, across the axis"""
    kind: ClassVar[str] = "edge"

    def fit(self, half: tuple[float, float]) -> None:
        width = 2 * self._extent(half)
        _require_radius(self.radius, SHARPEST * width, width)

    def _profile(self, s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        radius, right = abs(self.radius), math.pi / 2
        start = self.offset - radius * right / 2

        def curve(at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            angle = np.clip((at - start) / radius, 0, right)
            before, after = np.minimum(at - start, 0), np.maximum(at - start - radius * right, 0)
            return radius * np.sin(angle) + before, 2 * radius * np.sin(angle / 2) ** 2 + after, angle

        (p, q, angle), (p0, q0, angle0) = curve(s), curve(np.zeros(1))
        cosine, sine = np.cos(angle0), np.sin(angle0)
        p, q = p - p0, q - q0
        way = math.copysign(1.0, self.radius)
        return cosine * p + sine * q, way * (cosine * q - sine * p), way * (angle - angle0)


@dataclass(frozen=True)
class Cone(_Along):
    """Cone: a tag around a cup or a traffic cone, whose apex is above the tag."""

    radius: float
    """metres: radius of the cone at the centre of the marker"""
    taper: float
    """decrease of the radius per metre of height towards the apex, 0.001 to 100"""
    kind: ClassVar[str] = "cone"
    limits: ClassVar[dict[str, tuple]] = {
        "radius": _POSITIVE,
        "taper": ("a number from 0.001 to 100; a cylinder has none", 1e-3, 100),
    }

    def fit(self, half: tuple[float, float]) -> None:
        corners = np.array([[x, y] for x in (-1, 1) for y in (-1, 1)]) * half
        size = 2 * max(half)

        def fits(radius: float) -> bool:
            far, angle = self._unrolled(corners, radius)
            return bool(
                (far * np.cos(angle) > SHARPEST * size).all() and np.abs(angle).max() <= math.pi * self._sine
            )

        if not fits(self.radius):
            low, high = self.radius, 2 * max(self.radius, size * (1 + self.taper))
            for _ in range(60):
                middle = (low + high) / 2
                low, high = (low, middle) if fits(middle) else (middle, high)
            _require_radius(self.radius, high, size)

    @property
    def _sine(self) -> float:
        """Sine of the angle between the axis and the lines of the cone."""
        return self.taper / math.hypot(1, self.taper)

    def _unrolled(self, xy: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
        """Polar coordinates about the apex on the flat sheet: distances, and angles from the axis."""
        down = np.asarray(xy, np.float64) @ axis_of(self.axis) + radius / self._sine
        side = xy @ self.across
        return np.hypot(side, down), np.arctan2(side, down)

    def frames(self, xy: np.ndarray) -> Frames:
        far, angle = self._unrolled(xy, self.radius)
        sine, cosine = self._sine, 1 / math.hypot(1, self.taper)
        x, y = axis_of(self.axis)
        side, down, viewing = np.array([y, -x, 0.0]), np.array([x, y, 0.0]), np.array([0.0, 0.0, 1.0])
        outwards, axis = sine * down - cosine * viewing, cosine * down + sine * viewing
        rotation = (angle / sine)[:, None]
        line = sine * (np.cos(rotation) * outwards + np.sin(rotation) * side) + cosine * axis
        around = np.cos(rotation) * side - np.sin(rotation) * outwards
        points = far[:, None] * line - self.radius / sine * down
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
        by_side, by_down = s * line + c * around, c * line - s * around
        return Frames(points, y * by_side + x * by_down, -x * by_side + y * by_down)


@dataclass(frozen=True)
class Crumpled(SheetShape):
    """Crumpled sheet: a height field of creases in random directions.

    Each plane wave of creases is shortened in its direction so that lengths are preserved; where waves cross,
    the sheet is stretched by the product of their slopes, about 1 % at the largest height.
    """

    height: float
    """maximum difference of height [m], at most a tenth of `length`"""
    length: float
    """mean distance of creases [m]"""
    seed: int = 0
    kind: ClassVar[str] = "crumpled"
    limits: ClassVar[dict[str, tuple]] = {"length": _POSITIVE}

    def __post_init__(self) -> None:
        super().__post_init__()
        limit = f"0 to a tenth of the length, {self.length / 10:g} m"
        number("shape: height", self.height, limit, 0, self.length / 10)
        whole_number("shape: seed", self.seed, 0, 2**63 - 1)

    def fit(self, half: tuple[float, float]) -> None:
        _require_length(self.length, SHARPEST * max(half))

    def frames(self, xy: np.ndarray) -> Frames:
        xy = np.asarray(xy, np.float64)
        rng = np.random.default_rng(self.seed)
        azimuth = np.pi * (np.arange(WAVES) + rng.random(WAVES)) / WAVES
        ways = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
        wave = 2 * np.pi / self.length * rng.uniform(0.6, 1.4, WAVES)
        weights = rng.uniform(0.5, 1.5, WAVES)
        tall = self.height * weights / weights.sum()
        start = rng.uniform(0, 2 * np.pi, WAVES)

        phase = wave * (xy @ ways.T) + start
        z = (_crease(phase) - _crease(np.linspace(0, 2 * np.pi, 256, endpoint=False)).mean()) @ tall
        slope = tall * wave * np.sin(phase) / (4 * _crease(phase))
        shorter = -wave * tall**2 / 2 * (_squared_slopes(phase) - _squared_slopes(start))
        points = np.column_stack([xy + shorter @ ways, z])
        along = [
            np.column_stack([np.eye(2)[i] - (slope**2 / 2 * ways[:, i]) @ ways, slope @ ways[:, i]])
            for i in (0, 1)
        ]
        x, y = (tangent / np.linalg.norm(tangent, axis=1, keepdims=True) for tangent in along)
        middle, apart = x + y, x - y  # perpendicular, as x and y have the same length
        middle, apart = (array / np.linalg.norm(array, axis=1, keepdims=True) for array in (middle, apart))
        return Frames(points, (middle + apart) / math.sqrt(2), (middle - apart) / math.sqrt(2))


def _crease(phase: np.ndarray) -> np.ndarray:
    """Height of creases at phases of period 2 pi."""
    return np.sqrt(np.sin(phase / 2) ** 2 + CREASE**2)


def _squared_slopes(phase: np.ndarray) -> np.ndarray:
    """Integral of the squared derivative of `_crease` from 0, in closed form."""
    grown = math.hypot(1, CREASE)
    period = np.round(phase / (2 * np.pi))
    angle = np.arctan(grown / CREASE * np.tan(phase / 2 - np.pi * period)) + np.pi * period
    return (phase / 2 + np.sin(phase) / 2 + CREASE**2 * phase - 2 * CREASE * grown * angle) / 4


SHAPES: dict[str, type[SheetShape]] = {
    kind.kind: kind for kind in (Cylinder, Cone, BentSheet, BoxEdge, Crumpled)
}
"""classes of shapes by their names in scene files"""


def shape_of(shape: SheetShape | str | None) -> SheetShape | None:
    """Convert a shape, its text or None (flat) to a shape: "cylinder,radius=0.05,axis=x".

    Raises:
        InputError: an unknown shape or field, a missing field, or a value out of range.
    """
    if shape is None:
        return None
    if not isinstance(shape, str):
        remedy = "e.g. fidsplat.markers.Cylinder(radius=0.05)"
        return instance("shape", shape, SheetShape, "a shape, its text or None", remedy)
    name, *settings = (part.strip() for part in shape.split(","))
    if name not in SHAPES:
        raise InputError(unknown("shape", name, SHAPES))
    return from_fields("shape", SHAPES[name], parse_settings("shape", SHAPES[name], settings))


def axis_of(axis: str | tuple[float, ...]) -> np.ndarray:
    """Unit vector (2,) of an axis on the sheet."""
    if isinstance(axis, str):
        if axis not in ("x", "y"):
            raise InputError(f"shape: axis must be x, y or two numbers, got {axis!r}")
        return np.array([1.0, 0.0] if axis == "x" else [0.0, 1.0])
    numbers = real_array("shape: axis", axis, "x, y or two numbers")
    if numbers.shape != (2,) or not np.isfinite(numbers).all() or not numbers.any():
        raise InputError(f"shape: axis must be x, y or two numbers, not both 0, got {axis!r}")
    return numbers / np.linalg.norm(numbers)


def _require_length(length: float, smallest: float) -> None:
    if length < smallest:
        raise InputError(
            f"shape: length must be at least {smallest:g} m for this marker, got {length:g}; use a larger "
            "length"
        )


def _require_radius(radius: float, smallest: float, width: float) -> None:
    if abs(radius) < smallest:
        raise InputError(
            f"shape: radius must be at least {smallest:.4g} m for a sheet of {width:.4g} m with its quiet "
            f"zone, got {radius:g}; use a larger radius or a smaller size"
        )
