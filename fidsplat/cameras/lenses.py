"""Lens models: projection of directions in the camera frame to image coordinates, and its inverse.

A lens maps a point (X, Y, Z) of the camera frame to normalised image coordinates (a, b), which are
dimensionless, radians or metres; the pixel is x = fx a + cx, y = fy b + cy. Coefficients follow OpenCV.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar, TypeAlias

import numpy as np

from fidsplat.util.arguments import number, real_array
from fidsplat.util.directions import perpendicular
from fidsplat.util.errors import InputError

FISHEYE_LIMIT = math.radians(100)
"""largest angle in radians between a fisheye's rays and its axis: a field of view of 200 degrees"""
MAX_COEFFICIENT = 1e12
"""largest magnitude of a lens coefficient: more than any invertible lens has; products stay finite"""
_TABLE_SIZE = 4096  # entries of the table of initial values of Newton's method
_MAX_ITERATIONS = 12  # of Newton's method
_MIN_ANGLE_COSINE = math.cos(math.radians(1))  # to -z, which the stereographic projection maps to infinity
_NEGLIGIBLE = 1e-200  # smaller leading coefficients are dropped: roots would overflow


@dataclass(frozen=True)
class BrownConrady:
    """OpenCV's distortion model (`cv2.projectPoints`): radial (k1 to k6), tangential (p1, p2) and thin prism
    (s1 to s4). Directions beyond the first fold of the radial polynomial are outside the field of view.
    Raises InputError for a coefficient that is not finite."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    s1: float = 0.0
    s2: float = 0.0
    s3: float = 0.0
    s4: float = 0.0

    kind: ClassVar[str] = "brown_conrady"
    along_ray: ClassVar[bool] = False
    """whether depths are distances along the ray; otherwise they are along z"""

    def __post_init__(self) -> None:
        _check(self)

    @classmethod
    def opencv(cls, coefficients) -> BrownConrady:
        """Lens of OpenCV's distCoeffs: 4, 5, 8, 12 or 14 numbers (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 tx ty).
        Raises InputError for another count or a tilted sensor (tx or ty not 0)."""
        order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
        values = real_array("distortion", coefficients).ravel().tolist()
        if len(values) not in (4, 5, 8, 12, 14):
            raise InputError(
                f"distortion must have 4, 5, 8, 12 or 14 coefficients in OpenCV's order, got {len(values)}"
            )
        if any(values[12:]):
            raise InputError(
                "the last two distortion coefficients, which tilt the sensor, must be 0, got "
                f"{values[12]:g} and {values[13]:g}; calibrate without CALIB_TILTED_MODEL"
            )
        return cls(**dict(zip(order, values, strict=False)))

    @property
    def is_pinhole(self) -> bool:
        """Whether all coefficients are 0."""
        return not any(getattr(self, field.name) for field in fields(self))

    @cached_property
    def max_tangent(self) -> float:
        """Tangent of the angle from the axis up to which the radial polynomial increases, or inf."""
        numerator = np.polynomial.Polynomial([1, self.k1, self.k2, self.k3])
        denominator = np.polynomial.Polynomial([1, self.k4, self.k5, self.k6])
        q = np.polynomial.Polynomial([0, 2])
        slope = (numerator + q * numerator.deriv()) * denominator - q * numerator * denominator.deriv()
        return math.sqrt(min(_first_root(slope), _first_root(denominator)))

    def _distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Image coordinates and their derivatives with respect to x and y: a, b, a_x, a_y, b_x, b_y."""
        q = x * x + y * y
        numerator = 1 + q * (self.k1 + q * (self.k2 + q * self.k3))
        denominator = 1 + q * (self.k4 + q * (self.k5 + q * self.k6))
        numerator_slope = self.k1 + q * (2 * self.k2 + q * 3 * self.k3)
        denominator_slope = self.k4 + q * (2 * self.k5 + q * 3 * self.k6)
        radial = numerator / denominator
        slope = 2 * (numerator_slope - radial * denominator_slope) / denominator  # d radial / dx = slope x
        a = x * radial + 2 * self.p1 * x * y + self.p2 * (q + 2 * x * x) + q * (self.s1 + q * self.s2)
        b = y * radial + self.p1 * (q + 2 * y * y) + 2 * self.p2 * x * y + q * (self.s3 + q * self.s4)
        prism_a, prism_b = 2 * (self.s1 + 2 * q * self.s2), 2 * (self.s3 + 2 * q * self.s4)
        a_x = radial + x * x * slope + 2 * self.p1 * y + 6 * self.p2 * x + x * prism_a
        a_y = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y + y * prism_a
        b_x = x * y * slope + 2 * self.p1 * x + 2 * self.p2 * y + x * prism_b
        b_y = radial + y * y * slope + 6 * self.p1 * y + 2 * self.p2 * x + y * prism_b
        return a, b, a_x, a_y, b_x, b_y

    def image(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2) of points (n, 3); NaN behind the camera and beyond `max_tangent`."""
        points = _rows("points", points, 3)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
            a, b = self._distorted(x, y)[:2]
            inside = (points[:, 2] > 0) & (np.hypot(x, y) < self.max_tangent)
            visible = inside & np.isfinite(a) & np.isfinite(b)
        return np.where(visible[:, None], np.stack([a, b], 1), np.nan)

    def derivative(self, points: np.ndarray) -> np.ndarray:
        """Jacobian of the image coordinates with respect to X, Y, Z, (n, 2, 3), at visible points (n, 3)."""
        points = _rows("points", points, 3)
        z = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y = points[:, 0] / z, points[:, 1] / z
            by_x, by_y = np.array(self._distorted(x, y)[2:]).reshape(2, 2, -1).swapaxes(0, 1) / z
            return np.moveaxis(np.stack([by_x, by_y, -(x * by_x + y * by_y)]), (0, 1, 2), (2, 1, 0))

    def rays(self, image: np.ndarray) -> np.ndarray:
        """Directions (n, 3) = (X / Z, Y / Z, 1) of image coordinates (n, 2); NaN outside the field of
        view."""
        image = _rows("image", image, 2)
        a, b = image.T
        distance = np.hypot(a, b)
        x, y = _with_length(a, b, distance, self._undistorted(distance))
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for _ in range(_MAX_ITERATIONS):
                image_a, image_b, a_x, a_y, b_x, b_y = self._distorted(x, y)
                error_a, error_b = image_a - a, image_b - b
                determinant = a_x * b_y - a_y * b_x
                step_x = (b_y * error_a - a_y * error_b) / determinant
                step_y = (a_x * error_b - b_x * error_a) / determinant
                x, y = x - step_x, y - step_y
                if not np.nanmax(np.abs(error_a) + np.abs(error_b), initial=0.0) > 1e-13:
                    break
            image_a, image_b, a_x, a_y, b_x, b_y = self._distorted(x, y)
            visible = (np.abs(image_a - a) + np.abs(image_b - b) < 1e-9 * (1 + distance)) & (
                a_x * b_y > a_y * b_x
            )
            visible &= np.hypot(x, y) < self.max_tangent
        return np.where(visible[:, None], np.stack([x, y, np.ones_like(x)], 1), np.nan)

    def _undistorted(self, distance: np.ndarray) -> np.ndarray:
        """Tangents of the angles with these distances from the image centre, by the radial terms alone."""
        symmetric = BrownConrady(self.k1, self.k2, self.k3, self.k4, self.k5, self.k6)

        def radial(tangent: np.ndarray) -> np.ndarray:
            return symmetric._distorted(tangent, np.zeros(1))[0]

        max_distance = float(np.max(distance, initial=0.0))
        limit = min(1.0, self.max_tangent)
        while limit < self.max_tangent and limit < 1e4 and radial(np.array([limit]))[0] < max_distance:
            limit = min(2 * limit, self.max_tangent)
        tangents = np.linspace(0, limit * (1 - 1e-9), _TABLE_SIZE)
        return np.interp(distance, radial(tangents), tangents)

    @property
    def uniforms(self) -> tuple[float, ...]:
        """Uniforms of the kernels: k1 to k6, p1, p2, s1 to s4, and the square of `max_tangent`."""
        return (*(getattr(self, field.name) for field in fields(self)), min(self.max_tangent**2, 1e30))


@dataclass(frozen=True)
class Fisheye:
    """Kannala-Brandt fisheye (`cv2.fisheye`): a ray at the angle t from the axis has the distance t (1 + k1
    t^2 + k2 t^4 + k3 t^6 + k4 t^8) from the image centre; with coefficients 0, an equidistant fisheye. The
    field of view reaches 100 degrees from the axis, or less if that polynomial folds back earlier. Raises
    InputError for a coefficient that is not finite."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    kind: ClassVar[str] = "fisheye"
    along_ray: ClassVar[bool] = True
    is_pinhole: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check(self)

    @cached_property
    def max_angle(self) -> float:
        """Largest visible angle from the axis, radians."""
        slope = np.polynomial.Polynomial([1, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4])
        return min(math.sqrt(_first_root(slope)), FISHEYE_LIMIT)

    def image_radius(self, angle):
        """Distance from the image centre of a ray at an angle in radians from the axis."""
        q = angle * angle
        return angle * (1 + q * (self.k1 + q * (self.k2 + q * (self.k3 + q * self.k4))))

    def _slope(self, angle):
        """Derivative of the image radius with respect to the angle."""
        q = angle * angle
        return 1 + q * (3 * self.k1 + q * (5 * self.k2 + q * (7 * self.k3 + q * 9 * self.k4)))

    def derivative(self, points: np.ndarray) -> np.ndarray:
        """Jacobian of the image coordinates with respect to X, Y, Z, (n, 2, 3), at visible points (n, 3)."""
        points = _rows("points", points, 3)
        x, y, z = points.T
        radius = np.hypot(x, y)
        angle = np.arctan2(radius, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            cos, sin = np.where(radius > 0, x / radius, 1.0), np.where(radius > 0, y / radius, 0.0)
            per_angle = self._slope(angle) / (radius**2 + z**2)
            per_azimuth = np.where(radius > 0, self.image_radius(angle) / radius, 1 / z)
        by_radius = per_angle * np.stack([z * cos, z * sin, -radius])
        by_theta = per_azimuth * np.stack([-sin, cos, 0 * z])
        return np.moveaxis(
            np.stack([cos * by_radius - sin * by_theta, sin * by_radius + cos * by_theta]), 2, 0
        )

    def image(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2) of points (n, 3); NaN outside the field of view."""
        points = _rows("points", points, 3)
        radius = np.hypot(points[:, 0], points[:, 1])
        angle = np.arctan2(radius, points[:, 2])
        visible = np.asarray(angle <= self.max_angle) & np.asarray((radius > 0) | (points[:, 2] > 0))
        a, b = _with_length(points[:, 0], points[:, 1], radius, self.image_radius(angle))
        return np.where(visible[:, None], np.stack([a, b], 1), np.nan)

    def rays(self, image: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of image coordinates (n, 2); NaN outside the field of view."""
        image = _rows("image", image, 2)
        a, b = image.T
        distance = np.hypot(a, b)
        angles = np.linspace(0, self.max_angle, _TABLE_SIZE)
        angle = np.interp(distance, self.image_radius(angles), angles)
        for _ in range(_MAX_ITERATIONS):
            slope = self._slope(angle)
            error = self.image_radius(angle) - distance
            with np.errstate(divide="ignore", invalid="ignore"):
                step = np.where(slope > 1e-12, error / slope, 0.0)
            angle = np.clip(angle - step, 0.0, self.max_angle)
            if not np.abs(step).max(initial=0.0) > 1e-14:
                break
        x, y = _with_length(a, b, distance, np.sin(angle))
        visible = distance <= self.image_radius(self.max_angle)
        return np.where(visible[:, None], np.stack([x, y, np.cos(angle)], 1), np.nan)

    @property
    def uniforms(self) -> tuple[float, ...]:
        """Uniforms of the kernels: k1 to k4 and `max_angle`."""
        return (self.k1, self.k2, self.k3, self.k4, self.max_angle)


@dataclass(frozen=True)
class Equirectangular:
    """A panorama: a = longitude atan2(X, Z) from -pi to pi, b = latitude from -pi/2 (up, -y) to pi/2."""

    kind: ClassVar[str] = "equirectangular"
    along_ray: ClassVar[bool] = True
    is_pinhole: ClassVar[bool] = False
    uniforms: ClassVar[tuple[float, ...]] = ()

    def image(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2), radians, of points (n, 3); NaN for the camera's centre."""
        points = _rows("points", points, 3)
        x, y, z = points.T
        image = np.stack([np.arctan2(x, z), np.arctan2(y, np.hypot(x, z))], 1)
        return np.where(np.any(points != 0, axis=1)[:, None], image, np.nan)

    def derivative(self, points: np.ndarray) -> np.ndarray:
        """Jacobian (n, 2, 3) of the image coordinates with respect to X, Y, Z, at points (n, 3). At a pole,
        where the longitude jumps, it is the Jacobian of a point 1e-6 rad away towards z."""
        points = _rows("points", points, 3)
        x, y, z = points.T
        distance = np.linalg.norm(points, axis=1)
        polar = np.hypot(x, z) < 1e-6 * distance
        x, z = np.where(polar, 0.0, x), np.where(polar, 1e-6 * distance, z)
        horizontal = np.hypot(x, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            longitude = np.stack([z, 0 * y, -x]) / horizontal**2
            latitude = np.stack([-x * y / horizontal, horizontal, -z * y / horizontal]) / distance**2
        return np.moveaxis(np.stack([longitude, latitude]), 2, 0)

    def rays(self, image: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of image coordinates (n, 2); NaN beyond the sphere."""
        image = _rows("image", image, 2)
        a, b = image.T
        visible = (np.abs(a) <= math.pi) & (np.abs(b) <= math.pi / 2)
        rays = np.stack([np.sin(a) * np.cos(b), np.sin(b), np.cos(a) * np.cos(b)], 1)
        return np.where(visible[:, None], rays, np.nan)


@dataclass(frozen=True)
class Orthographic:
    """Parallel rays along z: a = X, b = Y in metres, so fx and fy are pixels per metre."""

    kind: ClassVar[str] = "orthographic"
    along_ray: ClassVar[bool] = False
    is_pinhole: ClassVar[bool] = False
    uniforms: ClassVar[tuple[float, ...]] = ()

    def image(self, points: np.ndarray) -> np.ndarray:
        """Image coordinates (n, 2), metres, of points (n, 3); NaN behind the camera."""
        points = _rows("points", points, 3)
        return np.where(points[:, 2:] > 0, points[:, :2], np.nan)

    def derivative(self, points: np.ndarray) -> np.ndarray:
        """Jacobian (n, 2, 3) of the image coordinates with respect to X, Y, Z, at points (n, 3)."""
        points = _rows("points", points, 3)
        return np.tile(np.eye(2, 3), (len(points), 1, 1))


@dataclass(frozen=True, eq=False)
class RayTable:
    """Arbitrary rays from one point, one for each pixel, for scanners. The camera has the size of the table,
    fx = fy = 1 and cx = cy = 0.

    Points have no image coordinates, so low-pass filters have no effect. Rendering is fastest if neighbours
    in the table have similar directions. Raises InputError for another shape, a table without rays, or a ray
    within 1 degree of -z.
    """

    directions: np.ndarray
    """(h, w, 3) float64 in the camera frame, normalised; NaN for a pixel without a ray"""
    divergence: float = 1e-3
    """full angle of a ray's beam in radians; it blurs the edges of box splats"""

    kind: ClassVar[str] = "ray_table"
    along_ray: ClassVar[bool] = True
    is_pinhole: ClassVar[bool] = False
    uniforms: ClassVar[tuple[float, ...]] = (0.0, 0.0, 0.0, 0.0, -1.0)
    """uniforms of a fisheye with an empty field of view, so that no splat's centre has an image"""

    def __post_init__(self) -> None:
        directions = real_array("directions", self.directions)
        if directions.ndim != 3 or directions.shape[2] != 3:
            raise InputError(f"directions must have the shape (h, w, 3), got {directions.shape}")
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = directions / np.linalg.norm(directions, axis=2, keepdims=True)
        if not np.isfinite(rays).any():
            raise InputError("directions must have a ray, got none with finite numbers and a length above 0")
        if (rays[..., 2] < -_MIN_ANGLE_COSINE).any():
            raise InputError(
                "directions must be at least 1 degree from -z, got a ray that is closer; turn the camera's "
                "axes"
            )
        rays.flags.writeable = False
        object.__setattr__(self, "directions", rays)
        number("divergence", self.divergence, "an angle above 0, at most 1 rad", 1e-9, 1.0)

    def image(self, points: np.ndarray) -> np.ndarray:
        """NaN (n, 2): points have no image coordinates."""
        return np.full((len(_rows("points", points, 3)), 2), np.nan)

    def derivative(self, points: np.ndarray) -> np.ndarray:
        """Jacobian (n, 2, 3) of coordinates across the beam, in beam widths, at points (n, 3)."""
        points = _rows("points", points, 3)
        distance = np.linalg.norm(points, axis=1, keepdims=True)
        return perpendicular(points / distance) / (self.divergence * distance[:, :, None])

    def rays(self, image: np.ndarray) -> np.ndarray:
        """Unit directions (n, 3) of the pixels of image coordinates (n, 2); NaN outside the table."""
        column, row = np.floor(_rows("image", image, 2)).astype(np.int64).T
        height, width = self.directions.shape[:2]
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        rays = self.directions[np.where(inside, row, 0), np.where(inside, column, 0)]
        return np.where(inside[:, None], rays, np.nan)


RayLens: TypeAlias = BrownConrady | Fisheye | Equirectangular | RayTable
"""lenses whose rays start at one point"""
Lens: TypeAlias = RayLens | Orthographic


def camera_effect(lens: Lens | None) -> str:
    """Name of the camera effect of a lens; a ray table uses the fisheye's projection of directions."""
    if lens is None:
        return "camera_pinhole"
    return "camera_fisheye" if isinstance(lens, RayTable) else f"camera_{lens.kind}"


def _rows(name: str, value: np.ndarray, width: int) -> np.ndarray:
    """Validated array (n, width) of real numbers; a NumPy array of floats is not copied."""
    if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
        value = real_array(name, value)
    if value.ndim != 2 or value.shape[1] != width:
        raise InputError(f"{name} must have the shape (n, {width}), got {value.shape}")
    return value


def _check(lens) -> None:
    for field in fields(lens):
        requirement = f"a finite number, in size at most {MAX_COEFFICIENT:g}"
        bounds = getattr(lens, field.name), requirement, -MAX_COEFFICIENT, MAX_COEFFICIENT
        object.__setattr__(lens, field.name, number(f"lens coefficient {field.name}", *bounds))


def _first_root(polynomial: np.polynomial.Polynomial) -> float:
    """Smallest root above 0; inf if there is none."""
    coefficients = polynomial.trim(_NEGLIGIBLE).coef
    # a root that overflows is beyond all images
    with np.errstate(over="ignore"):
        roots = np.polynomial.Polynomial(coefficients).roots() if len(coefficients) > 1 else np.empty(0)
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(real.min()) if len(real) else math.inf


def _with_length(a: np.ndarray, b: np.ndarray, length: np.ndarray, target: np.ndarray):
    """Vectors (a, b) of these lengths, scaled to target lengths; 0 stays 0."""
    factor = target / np.where(length > 0, length, 1.0)
    return a * factor, b * factor
