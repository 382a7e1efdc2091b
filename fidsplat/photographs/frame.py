"""World frame of a capture: gravity, origin and scale, as a similarity from the model of the photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera

PITCHED = 0.002
"""weight of the cameras' mean up direction, which determines the vertical if the x axes of all cameras are
parallel"""
MIN_SPREAD = 0.05
"""minimum variance of the cameras' x axes, across their mean, that determines the vertical: 13 degrees"""


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """Similarity from the model to the world: z up, metres."""

    rotation: np.ndarray
    """(3, 3), world from model"""
    origin: np.ndarray
    """(3,), origin of the world in the model"""
    scale: float
    """metres for each unit of the model"""

    def points(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) in the world."""
        return self.scale * (points - self.origin) @ self.rotation.T

    def camera(self, camera: Camera) -> Camera:
        """A camera in the world."""
        return camera.with_pose(camera_to_world=self.pose(camera.camera_to_world))

    def pose(self, pose: np.ndarray) -> np.ndarray:
        """A rigid pose (4, 4) in the world."""
        moved = np.eye(4)
        moved[:3, :3] = self.rotation @ pose[:3, :3]
        moved[:3, 3] = self.points(pose[None, :3, 3])[0]
        return moved


def world_frame(
    cameras: Sequence[Camera],
    scale: float,
    tag: np.ndarray | None = None,
    vertical: bool = False,
    middle: np.ndarray | None = None,
) -> WorldFrame:
    """Determine the world frame: gravity, origin and scale.

    Args:
        scale: metres for each unit of the model.
        tag: pose (4, 4) of the tag that defines the origin and the direction of x.
        vertical: whether the tag's axis nearest to the cameras' up direction is vertical. Otherwise the
            cameras' horizontal axes determine the vertical.
        middle: (3,) origin in the model without a tag; by default the cameras' mean position.
    """
    up = camera_up(cameras)
    if tag is not None and vertical:
        axes = np.concatenate([tag[:3, :3].T, -tag[:3, :3].T])
        up = axes[np.argmax(axes @ up)]
    directions = cameras[0].world_to_camera[:1, :3] if tag is None else tag[:3, :2].T
    along = max((each - (each @ up) * up for each in directions), key=lambda each: float(each @ each))
    along = along / np.linalg.norm(along)
    rotation = np.stack([along, np.cross(up, along), up])
    if tag is not None:
        origin = tag[:3, 3]
    else:
        origin = np.mean([camera.position for camera in cameras], axis=0) if middle is None else middle
    return WorldFrame(rotation, np.asarray(origin, np.float64), scale)


def leaning(cameras: Sequence[Camera], up: np.ndarray) -> float:
    """Angle [rad] between a vertical and that of the cameras' x axes; 0 if these are too parallel for one."""
    across = np.array([camera.world_to_camera[0, :3] for camera in cameras])
    if np.linalg.eigvalsh(across.T @ across / len(across))[1] < MIN_SPREAD:
        return 0.0
    return float(np.arccos(np.clip(camera_up(cameras) @ up, -1, 1)))


def camera_up(cameras: Sequence[Camera]) -> np.ndarray:
    """Unit vector of the vertical: the least-squares normal to the cameras' x axes, as people hold cameras
    level."""
    across = np.array([camera.world_to_camera[0, :3] for camera in cameras])
    mean = -np.mean([camera.world_to_camera[1, :3] for camera in cameras], axis=0)
    up = np.linalg.solve(across.T @ across / len(across) + PITCHED * np.eye(3), mean)
    return up / np.linalg.norm(up)
