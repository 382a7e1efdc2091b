"""Surface at a pixel of a scene, from the rendered median depth."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import Sensor
from fidsplat.scenes.surface import Surface, fit_surface
from fidsplat.util.arguments import instance, number, real_array
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.render.renderer import Renderer
    from fidsplat.render.resident import ResidentCloud
    from fidsplat.scenes import Scene

PATCH_SIZE = 32
"""pixels per side of the rendered patch"""
RADIUS_FRACTION, MIN_RADIUS = 0.02, 8.0
"""default radius of the fitted patch: fraction of the image width, and minimum in pixels"""
MEDIAN_OPACITY = 0.5
"""accumulated opacity at the median depth; pixels of a lower opacity have no surface"""
_RAY_FOV = 0.1
"""field of view [rad] of the camera around a ray"""


def surface_at(
    scene: Scene,
    camera: Camera | None = None,
    pixel=None,
    *,
    ray=None,
    radius: float | None = None,
    renderer: Renderer | None = None,
    resident: ResidentCloud | None = None,
) -> Surface:
    """The surface of a scene at a pixel or along a ray.

    A plane is fitted to the median depth of a round patch. Up to half of the patch may be outliers, such as
    leaves in front of a wall.

    Args:
        scene: splats and markers, at the time of the scene's shutter.
        camera: used at its own pose. Default: the scene's camera at the shutter time.
        pixel: (x, y), 0 to width and 0 to height.
        ray: (origin (3,), direction (3,)) in the world, instead of camera and pixel.
        radius: metres, radius of the patch; by default 2 % of the width of the image, at least 8 pixels;
            along a ray 0.025 times the distance.
        renderer: by default one on the scene's device.
        resident: the uploaded scene, for many calls.

    Raises:
        InputError: no plane in at least half of the patch; a pixel outside the image; unusable arguments.
    """
    if camera is not None:
        instance(
            "camera", camera, Camera, "a Camera, with pixel=(x, y)", "give a ray as ray=(origin, direction)"
        )
    capture = scene.capture
    if camera is None and scene.camera is not None:
        camera = capture.motion.moved(scene.camera, capture.shutter.time)
    camera, pixel = _camera_and_pixel(camera, pixel, ray)
    if radius is not None:
        radius = number("radius", radius, "a positive length in metres", 1e-9)
    if renderer is None:
        from fidsplat.render.renderer import Renderer  # imported here, as most callers pass a renderer

        renderer = Renderer(scene.device)
    resident_scene = renderer.upload(scene) if resident is None else resident
    capture_of_depth = median_depth_capture(capture)

    def depth_of(patch: Camera) -> np.ndarray:
        return renderer.render(resident_scene, capture_of_depth.with_(camera=patch))["depth_first"]

    radius_px = default_radius(camera)
    if radius is not None:
        default_depth = _median_of(depth_of(_patch(camera, pixel, radius_px)))
        default_radius_m = _radius_in_metres(camera, pixel, radius_px, default_depth)
        radius_px = min(radius_px * radius / default_radius_m, 2.0 * camera.width)
    patch = _patch(camera, pixel, radius_px)
    depth = depth_of(patch)
    radius_m = _radius_in_metres(camera, pixel, radius_px, _median_of(depth))
    return _fit_patch(depth, patch, (PATCH_SIZE / 2, PATCH_SIZE / 2), PATCH_SIZE / 2, radius_m)


def surface_from_depth(depth: np.ndarray, camera: Camera, pixel, radius: float | None = None) -> Surface:
    """Fit a plane around a pixel of a median depth image.

    Args:
        depth: (h, w) metres, the output `depth_first` at `first_hit=0.5`; 0 where the opacity is below 0.5.
        camera: camera of the image.
        pixel: (x, y), 0 to width and 0 to height.
        radius: radius of the patch in pixels; by default 2 % of the width, at least 8.

    Raises:
        InputError: no plane in at least half of the patch; a pixel outside the image.
    """
    camera, pixel = _camera_and_pixel(camera, pixel, None)
    radius_px = default_radius(camera) if radius is None else radius
    x, y = (int(v) for v in pixel)
    half_side, step = int(np.ceil(radius_px)), max(1, int(radius_px) // (PATCH_SIZE // 4))
    left, top = max(x - half_side, 0), max(y - half_side, 0)
    patch = depth[top : y + half_side + 1 : step, left : x + half_side + 1 : step]
    radius_m = _radius_in_metres(camera, pixel, radius_px, _median_of(patch))

    def in_patch(coordinate: float, first: int) -> float:
        return (coordinate - first - 0.5) / step + 0.5

    height, width = patch.shape
    focal = {"fx": camera.fx / step, "fy": camera.fy / step}
    center = {"cx": in_patch(camera.cx, left), "cy": in_patch(camera.cy, top)}
    patch_camera = replace(camera, width=width, height=height, **focal, **center)
    patch_pixel = in_patch(pixel[0], left), in_patch(pixel[1], top)
    return _fit_patch(patch, patch_camera, patch_pixel, radius_px / step, radius_m)


def median_depth_capture(capture: Capture, *outputs: str) -> Capture:
    """Capture whose `depth_first` is the median depth, with further outputs; one pose, splats at the
    shutter's time, no sensor, fog or external depth image."""
    # `depth_first` with first_hit = 0.5: the depth at which the opacity reaches one half; unlike
    # `depth_median`, it is 0 where the opacity is below one half
    quality = replace(capture.quality, samples=1, first_hit=MEDIAN_OPACITY)
    motion, shutter = Motion(None, capture.motion.groups), Shutter(time=capture.shutter.time)
    outputs = ("depth_first", *outputs)
    base = capture.with_(outputs=outputs, quality=quality, motion=motion, shutter=shutter)
    return replace(base, sensor=Sensor(), background=(0.0, 0.0, 0.0), fog=None, external_depth=None)


def default_radius(camera: Camera) -> float:
    """Radius of the patch in pixels."""
    return max(RADIUS_FRACTION * camera.width, MIN_RADIUS)


def _camera_and_pixel(camera: Camera | None, pixel, ray) -> tuple[Camera, tuple[float, float]]:
    if (pixel is None) == (ray is None):
        given = "neither" if pixel is None else "both"
        raise InputError(
            f"exactly one of pixel and ray must be given, got {given}; give pixel=(x, y) or "
            "ray=(origin, direction)"
        )
    if ray is not None:
        return _ray_camera(ray), (PATCH_SIZE / 2, PATCH_SIZE / 2)
    if camera is None:
        raise InputError("camera must be given for a scene without a camera, got None; pass camera=")
    point = real_array("pixel", pixel, "two numbers")
    if point.shape != (2,) or not (0 <= point[0] <= camera.width and 0 <= point[1] <= camera.height):
        raise InputError(
            f"pixel must be (x, y) in the image, 0 to {camera.width} and 0 to {camera.height}, got {pixel!r}"
        )
    return camera, (float(point[0]), float(point[1]))


def _ray_camera(ray) -> Camera:
    try:
        origin, direction = (real_array("ray", part, "three numbers") for part in ray)
    except (TypeError, ValueError):
        raise InputError(f"ray must be an origin (3,) and a non-zero direction (3,), got {ray!r}") from None
    parts = origin, direction
    if any(part.shape != (3,) or not np.isfinite(part).all() for part in parts) or not direction.any():
        raise InputError(
            f"ray must be a finite origin (3,) and a finite non-zero direction (3,), got {ray!r}"
        )
    up = np.eye(3)[np.argmin(np.abs(direction))]
    unit_direction = direction / np.linalg.norm(direction)
    return Camera.look_at(PATCH_SIZE, PATCH_SIZE, _RAY_FOV, origin, origin + unit_direction, up, near=1e-3)


def _patch(camera: Camera, pixel: tuple[float, float], radius: float) -> Camera:
    """Camera of the square around a pixel with half sides of `radius` pixels."""
    zoom = PATCH_SIZE / (2 * radius)
    cx = (camera.cx - pixel[0] + radius) * zoom
    cy = (camera.cy - pixel[1] + radius) * zoom
    return replace(
        camera, width=PATCH_SIZE, height=PATCH_SIZE, fx=camera.fx * zoom, fy=camera.fy * zoom, cx=cx, cy=cy
    )


def _median_of(depth: np.ndarray) -> float:
    depths = depth[depth > 0]
    if not len(depths):
        raise InputError(
            f"the scene near the pixel or ray must have an opacity of at least {MEDIAN_OPACITY}, got less "
            "in all of the patch, as of the sky; give another one"
        )
    return float(np.median(depths))


def _radius_in_metres(camera: Camera, pixel: tuple[float, float], radius_px: float, depth: float) -> float:
    """Convert a radius in pixels at a depth to metres."""
    pixels_at = np.array([pixel, (pixel[0] + radius_px, pixel[1]), (pixel[0] - radius_px, pixel[1])])
    center, *others = camera.unproject(pixels_at, np.full(3, depth))
    return float(np.nanmax(np.linalg.norm(others - center, axis=1)))


def _fit_patch(
    depth: np.ndarray, camera: Camera, pixel: tuple[float, float], radius_px: float, radius_m: float
) -> Surface:
    centers = camera.pixel_centers
    mask = ((centers - pixel) ** 2).sum(2) <= max(radius_px, 1.0) ** 2
    depths = depth[mask].astype(np.float64)
    points = camera.unproject(centers[mask], np.where(depths > 0, depths, np.nan))
    origin, further = camera.unproject(np.array([pixel, pixel]), np.array([0.0, 1.0]))
    return fit_surface(points, origin, further - origin, radius_m)
