"""Ideal images of printed tags among splats: exact mean of the texture in each pixel."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.environment import ExternalDepth
from fidsplat.experiments.plane import plane_image
from fidsplat.scenes import PlacedMarker

_MIN_COVERAGE = 1 / 512
"""minimum covered fraction of a pixel that belongs to a tag"""


def tag_depth_image(tags: Iterable[PlacedMarker], camera: Camera, behind: np.ndarray) -> ExternalDepth:
    """External depth image of printed tags, for a frame without the tags.

    A partly covered pixel is blended with the frame, and has the depth of the tag.

    Args:
        tags: black and white markers; tags that face away or reach behind the camera are skipped.
        camera: a pinhole camera.
        behind: (h, w, 3) frame without the tags.
    """
    rgb, depth = np.array(behind, np.float64), np.zeros(behind.shape[:2])
    poses = [(camera.world_to_camera @ tag.pose, tag) for tag in tags]
    for pose, tag in sorted(poses, key=lambda pair: -float(np.linalg.norm(pair[0][:3, 3]))):
        window = _window(pose, tag, camera)
        if window is None:
            continue
        left, top, right, bottom = window
        part = replace(
            camera,
            **{"width": right - left, "height": bottom - top, "cx": camera.cx - left, "cy": camera.cy - top},
            **{"world_to_camera": pose, "position": None},
        )
        grid, module = tag.marker.grid, tag.marker.module
        light = plane_image(grid, module, part, 0.0, 1.0, 0.0)
        covered = plane_image(np.zeros_like(grid), module, part, 0.0, 1.0, 0.0)
        tag_depth = _depth(pose, part)
        inside = (covered > _MIN_COVERAGE) & (tag_depth > 0)
        white, black = tag.marker.palette
        color = light[..., None] * white + (covered - light)[..., None] * black
        rows = slice(top, bottom), slice(left, right)
        mixed = color + (1 - covered)[..., None] * rgb[rows]
        rgb[rows] = np.where(inside[..., None], mixed, rgb[rows])
        depth[rows] = np.where(inside, tag_depth, depth[rows])
    return ExternalDepth(rgb, depth)


def _window(pose: np.ndarray, tag: PlacedMarker, camera: Camera) -> tuple[int, int, int, int] | None:
    """Bounding box (left, top, right, bottom) of a tag; None if it is not visible. pose: camera from
    marker."""
    height, width = np.array(tag.marker.grid.shape) * tag.marker.module / 2
    corners = np.array([(x, y, 0.0) for x in (-width, width) for y in (-height, height)])
    points = corners @ pose[:3, :3].T + pose[:3, 3]
    if points[:, 2].min() <= camera.near or pose[:3, 2] @ pose[:3, 3] <= 0:
        return None
    pixels = camera.with_pose(np.eye(4)).project(points)
    low = np.maximum(np.floor(pixels.min(0)).astype(int), 0)
    high = np.minimum(np.ceil(pixels.max(0)).astype(int), (camera.width, camera.height))
    return (*low.tolist(), *high.tolist()) if (low < high).all() else None


def _depth(pose: np.ndarray, camera: Camera) -> np.ndarray:
    """Depth along z of a marker's plane at each pixel, (h, w) metres."""
    rays = camera.rays(camera.pixel_centers.reshape(-1, 2)).reshape(camera.height, camera.width, 3)
    with np.errstate(divide="ignore"):
        return pose[:3, 2] @ pose[:3, 3] / (rays @ pose[:3, 2])
