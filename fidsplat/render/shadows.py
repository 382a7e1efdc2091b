"""Shadow maps: transmittance of the splats between the points of a light and a marker."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fidsplat.cameras import Camera, Motion, look_at_matrix
from fidsplat.cameras.lenses import Orthographic
from fidsplat.capture.capture import Capture
from fidsplat.capture.environment import ExternalDepth
from fidsplat.render.irradiance import neighbours
from fidsplat.scenes.lights import Light, PointLight, SpotLight, Sun
from fidsplat.util.directions import disk, perpendicular, unit

if TYPE_CHECKING:
    from fidsplat.render.resident import ResidentCloud

MAX_PIXELS = 512
"""maximum pixels of the marker along a side of a shadow map, without the border"""
_MARGIN = 4
"""width [pixels] of the border around the marker"""
_MAX_TANGENT = np.tan(np.radians(80))
"""tangent of half the maximum field of view of a shadow map; there are no shadows beyond it"""


@dataclass(frozen=True, eq=False)
class ReceiverPoints:
    """Points of a surface that receives light."""

    positions: np.ndarray
    """(m, 3) in the world"""
    normals: np.ndarray
    """(m, 3) unit, towards the viewer"""
    pitch: float
    """metres between neighbours"""
    clearance: float
    """metres in front of the marker within which splats cast no shadow"""

    @cached_property
    def middle(self) -> np.ndarray:
        return (self.positions.min(axis=0) + self.positions.max(axis=0)) / 2

    @cached_property
    def radius(self) -> float:
        """Largest distance of a point from the middle [m], at least the pitch."""
        return max(float(np.linalg.norm(self.positions - self.middle, axis=1).max()), self.pitch)

    @cached_property
    def is_flat(self) -> bool:
        return bool(np.ptp(self.normals, axis=0).max() < 1e-9)


class LightPoint(NamedTuple):
    """A point of a light, from which a shadow map is rendered."""

    light: Light
    position: np.ndarray
    """(3,) position; for a sun the direction of its light"""
    power_fraction: float
    """fraction of the light's power"""

    def irradiance(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit directions (m, 3) from positions (m, 3) to the light, and the unshadowed irradiance (m, 3) of
        surfaces that face it."""
        power = self.power_fraction * self.light.power
        if isinstance(self.light, Sun):
            return np.broadcast_to(-self.position, positions.shape), np.broadcast_to(power, positions.shape)
        to_light = self.position - positions
        distance = np.maximum(np.linalg.norm(to_light, axis=1, keepdims=True), 1e-9)
        to_light, irradiance = to_light / distance, power / distance**2
        if isinstance(self.light, SpotLight):
            low, high = np.cos(self.light.outer), np.cos(self.light.inner)
            cosine = -to_light @ unit(np.array(self.light.direction))
            irradiance = irradiance * np.clip((cosine - low) / (high - low), 0, 1)[:, None] ** 2
        return to_light, irradiance


def light_points(light: Light, middle: np.ndarray) -> list[LightPoint]:
    """Sample points of a light on the disk that faces the position `middle` (3,)."""
    size = light.angle if isinstance(light, Sun) else getattr(light, "radius", 0.0)
    count = light.samples if size > 0 else 1
    fractions, points = np.full(count, 1 / count), disk(count) * (count > 1)
    if isinstance(light, Sun):
        axis = unit(np.array(light.direction))
        offset = np.sin(size / 2) * (points @ perpendicular(axis))
        cosine = np.sqrt(1 - (offset**2).sum(axis=1))
        points = cosine[:, None] * axis + offset
        fractions = fractions / cosine  # so that the irradiance of a surface that faces the sun is `power`
    else:
        assert isinstance(light, PointLight)
        center = np.array(light.position)
        points = center + size * (points @ perpendicular(unit(center - middle)))
    return [LightPoint(light, *pair) for pair in zip(points, fractions, strict=True)]


def shadow_casters(
    light: Light, surface: ReceiverPoints, centers: np.ndarray, radii: np.ndarray
) -> np.ndarray:
    """Rows of the spheres, centres (n, 3) and radii (n,), that may cast shadows on a surface: in front of the
    surface, and inside the capsule from the surface to the light (a cone for a sun)."""
    # heights are dot products with `normal`, which is not a unit vector
    middle, normal = surface.middle, surface.normals.mean(axis=0)
    radius = surface.radius + _MARGIN * surface.pitch
    length, offsets = float(np.linalg.norm(normal)), centers - middle
    receivers = surface.positions + surface.clearance * surface.normals
    min_height = ((receivers - middle) @ normal).min() - surface.pitch
    if isinstance(light, Sun):
        to_light = -unit(np.array(light.direction))
        along = offsets @ to_light
        distance_from_axis = np.linalg.norm(offsets - along[:, None] * to_light, axis=1)
        max_distance = radius + np.tan(light.angle / 2) * np.maximum(along + radii, 0)
        inside = (distance_from_axis - radii <= max_distance) & (along + radii >= -radius)
        above = to_light @ normal > np.sin(light.angle / 2) * length  # the whole sun is in front
        min_height = min_height if above else -np.inf
    else:
        assert isinstance(light, PointLight)
        to_light = np.array(light.position) - middle
        along = np.clip(offsets @ to_light / max(to_light @ to_light, 1e-12), 0, 1)
        distance_from_axis = np.linalg.norm(offsets - along[:, None] * to_light, axis=1)
        inside = distance_from_axis - radii <= max(radius, light.radius)
        min_height = min(min_height, to_light @ normal - light.radius * length)
    return np.flatnonzero(inside & (offsets @ normal + radii * length >= min_height))


def visibility(
    point: LightPoint,
    surface: ReceiverPoints,
    casters: ResidentCloud | None,
    motion: Motion,
    extent: float,
    renderer: Any,
) -> np.ndarray:
    """Transmittance (m,) float32 between the surface's points and a point of a light; 0 where the surface
    faces away.

    The marker is an opaque white surface in an external depth image, and other splats are black, so that the
    image rendered from the light is the transmittance. casters: black splats between the surface and the
    light, moved by `motion`; None: no splats. extent: largest distance of a splat from the marker.
    """
    to_light, irradiance = point.irradiance(surface.positions)
    visible = np.zeros(len(to_light), np.float32)
    facing = (np.einsum("mc,mc->m", to_light, surface.normals) > 0) & (irradiance @ np.ones(3) > 0)
    if casters is None:
        visible[facing] = 1
    elif facing.any():
        points, normals = surface.positions[facing], surface.normals[facing]
        camera = _camera(point, surface, extent + surface.clearance)
        surface_points = points + surface.clearance * normals
        if surface.is_flat:  # three points of its plane
            offsets = surface.pitch * np.pad(perpendicular(normals[0]), ((1, 0), (0, 0)))
            surface_points = surface_points[0] + offsets
        depth = _depth_image(camera, surface_points)
        image = ExternalDepth(np.ones((*depth.shape, 3), np.float32), depth)
        frame = renderer.render(casters, Capture(camera, motion=motion, external_depth=image))
        visible[facing] = _bilinear(np.asarray(frame["rgb"][..., 0]), camera.project(points))
    return visible


def _camera(point: LightPoint, surface: ReceiverPoints, extent: float) -> Camera:
    """Camera of a shadow map, at the light's point; for a sun, beyond all splats."""
    middle, radius = surface.middle, surface.radius
    marker_side = int(np.clip(np.ceil(2 * radius / surface.pitch), 8, MAX_PIXELS))  # pixels
    side = marker_side + 2 * _MARGIN
    if isinstance(point.light, Sun):
        pose = look_at_matrix(
            middle - (extent + 2 * radius) * point.position, middle, perpendicular(point.position)[0]
        )
        return Camera.orthographic(side, side, 2 * radius * side / marker_side, pose, near=1e-6)
    distance = float(np.linalg.norm(middle - point.position))
    tangent = min(radius / np.sqrt(max(distance**2 - radius**2, 1e-12)), _MAX_TANGENT)
    focal = marker_side / (2 * tangent)
    pose = look_at_matrix(point.position, middle, perpendicular(unit(middle - point.position))[0])
    return Camera.pinhole(side, side, focal, focal, side / 2, side / 2, pose, near=min(1e-3, distance / 10))


def _depth_image(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Depth (h, w) of a surface: a plane fitted to points (m, 3), plus their residuals."""
    pixels = camera.project(points)
    z = (points - camera.position) @ camera.world_to_camera[2, :3]
    inverse = not isinstance(camera.lens, Orthographic)  # 1 / z of a plane is affine in the pixel
    value = 1 / np.maximum(z, 1e-9) if inverse else z
    inside = np.isfinite(pixels).all(axis=1)
    pixels, value = pixels[inside], value[inside]
    plane = np.linalg.lstsq(_affine(pixels), value, rcond=None)[0]
    height, width = camera.height, camera.width
    image = (_affine(camera.pixel_centers.reshape(-1, 2)) @ plane).reshape(height, width)
    residual = value - _affine(pixels) @ plane
    if len(residual) and np.abs(residual).max() > 1e-6 * np.abs(value).max():  # a curved surface
        column, row = np.clip(pixels.astype(int), 0, (width - 1, height - 1)).T
        total, count = np.zeros((height, width)), np.zeros((height, width))
        np.add.at(total, (row, column), residual)
        np.add.at(count, (row, column), 1)
        for dy in (-1, 0, 1):  # pixels without points use the residuals of their neighbours
            for dx in (-1, 0, 1):
                if dx or dy:
                    total += 1e-6 * np.roll(total, (dy, dx), (0, 1))
                    count += 1e-6 * np.roll(count, (dy, dx), (0, 1))
        image += np.where(count > 0, total / np.maximum(count, 1e-30), 0)
    with np.errstate(divide="ignore"):
        depth = np.where(image > 0, 1 / image, np.inf) if inverse else image
    return np.where(depth > 0, depth, np.inf).astype(np.float32)


def _affine(pixels: np.ndarray) -> np.ndarray:
    return np.column_stack([pixels, np.ones(len(pixels))])


def _bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Values of an image (h, w) at pixel coordinates (m, 2); 1 outside."""
    height, width = image.shape
    inside = ((pixels >= 0) & (pixels < (width, height))).all(axis=1)  # NaN is outside
    x, y = np.clip(np.where(inside.reshape(-1, 1), pixels, 0) - 0.5, 0, (width - 1, height - 1)).T
    padded = np.pad(image, ((0, 1), (0, 1)))
    return np.where(inside, sum(weight * padded[cell] for cell, weight in neighbours(x, y)), 1.0)
