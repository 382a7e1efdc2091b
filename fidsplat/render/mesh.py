"""Mesh of a scene, from depth images of many views that are fused into a distance field."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.formats.meshes import TriangleMesh
from fidsplat.render.renderer import Renderer
from fidsplat.render.surface import median_depth_capture
from fidsplat.render.tsdf import DistanceField
from fidsplat.scenes import Scene
from fidsplat.splats.statistics import guess_up
from fidsplat.util.arguments import items, number
from fidsplat.util.errors import InputError
from fidsplat.util.progress import Progress, no_progress

VIEWS, IMAGE_SIDE, FOV = 64, 512, math.radians(50.0)
"""views around a scene: their maximum number, pixels per side and field of view [rad]"""
RESOLUTION = 200
"""voxels along the longest side of a scene"""
_TINY = 1e-300
"""minimum length of a voxel [m]"""
MAX_VOXELS = 1 << 19
"""maximum number of voxels per side of a scene, far within the range of the keys of a DistanceField"""


def scene_mesh(
    scene: Scene,
    cameras: Iterable[Camera] | None = None,
    voxel: float | None = None,
    renderer: Renderer | None = None,
    progress: Progress | None = None,
) -> TriangleMesh:
    """Triangle mesh of a scene's surfaces, with colours at the vertices.

    The median depth of each view is fused into a truncated signed distance field; pixels with an opacity
    below one half are empty. Surfaces that are thinner than two voxels and visible from both sides are lost.

    Args:
        cameras: views; by default up to 64 views from a sphere around the scene; if the scene has a ground,
            only views at least 5.7 degrees above the horizontal.
        voxel: metres; by default a 200th of the longest side of the scene.
        renderer: by default one on the scene's device.
        progress: called with the name of the current step and its completed fraction.

    Raises:
        InputError: no splats; no cameras; a voxel size that is not positive or too small.
    """
    low, high = _bounds(scene)
    size = float((high - low).max())
    voxel = (
        size / RESOLUTION if voxel is None else number("voxel", voxel, "a positive length in metres", _TINY)
    )
    if size / voxel > MAX_VOXELS:
        raise InputError(f"voxel must be at least {size / MAX_VOXELS:.2g} m for this scene, got {voxel:g}")
    views = list(
        views_around(scene, low, high)
        if cameras is None
        else items("cameras", cameras, Camera, "a list of Camera")
    )
    if not views:
        raise InputError(
            "cameras must have at least one camera, got none; leave them out for views around the scene"
        )
    renderer = Renderer(scene.device) if renderer is None else renderer
    report: Callable[[str, float], object] = progress or no_progress
    capture = median_depth_capture(scene.capture, "rgb", "normal")
    field = DistanceField(voxel, (low + high) / 2)
    images = []
    captures = [capture.with_(camera=camera) for camera in views]
    frames = renderer.render_views(renderer.upload(scene), captures)
    for k, frame in enumerate(frames):
        depth = frame["depth_first"]  # at an opacity of one half (`median_depth_capture`)
        field.allocate(depth, views[k])
        images.append((depth, _cosine(frame["normal"], views[k]), frame.to_uint8()))
        report("rendering views", 0.5 * (k + 1) / len(views))
    for k, (depth, cosine, rgb) in enumerate(images):
        field.integrate(depth, cosine, rgb.astype(np.float32) / 255, views[k])
        report("fusing views", 0.5 + 0.5 * (k + 1) / len(views))
    return field.mesh()


def _cosine(normal: np.ndarray, camera: Camera) -> np.ndarray:
    """Cosine (h, w) float32 of the angle between the rays and the normals (h, w, 3), at least 0.1."""
    pixels = camera.pixel_centers.reshape(-1, 2)
    origins, points = (camera.unproject(pixels, np.full(len(pixels), depth)) for depth in (0.0, 1.0))
    rays = ((points - origins) @ camera.world_to_camera[:3, :3].T).reshape(normal.shape)
    cosine = -(normal * rays).sum(2) / np.linalg.norm(rays, axis=2)
    return np.nan_to_num(np.maximum(cosine, 0.1), nan=0.1).astype(np.float32)


def views_around(scene: Scene, low: np.ndarray, high: np.ndarray) -> list[Camera]:
    """Cameras on a sphere around a bounding box, spaced by the golden angle; if the scene has a
    ground, none less than 5.7 degrees above the horizontal."""
    up_axis = guess_up(scene.cloud())
    center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
    distance = radius / math.sin(FOV / 2)
    k = np.arange(VIEWS)
    z = 1 - (2 * k + 1) / VIEWS
    angle, horizontal = math.pi * (1 + 5**0.5) * k, np.sqrt(1 - z * z)
    directions = np.stack([horizontal * np.cos(angle), horizontal * np.sin(angle), z], 1)
    cameras = []
    for direction in directions:
        if up_axis.ground and direction @ up_axis.direction < 0.1:
            continue
        up = up_axis.direction if abs(direction @ up_axis.direction) < 0.99 else np.roll(up_axis.direction, 1)
        near = max(distance - 1.5 * radius, 1e-3 * radius)
        cameras.append(
            Camera.look_at(IMAGE_SIDE, IMAGE_SIDE, FOV, center + distance * direction, center, up, near=near)
        )
    return cameras


def _bounds(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the bounding box of the middle 99 % of the centres along each axis, enlarged by the 90th
    percentile of the scales."""
    cloud = scene.cloud()
    if not len(cloud):
        raise InputError("the scene of a mesh must have at least one splat, got none; add splats or markers")
    low, high = np.percentile(cloud.means.astype(np.float64), (0.5, 99.5), axis=0) + cloud.origin
    margin = np.percentile(cloud.scales, 90)
    return low - margin, high + margin
