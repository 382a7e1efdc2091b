"""Scenes from scene files, or from splat files and stores (chunks on disk) with a camera that frames them."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.quality import Quality
from fidsplat.formats.files import FORMATS, NAMED, load_splats, remedy_for
from fidsplat.formats.trajectories import load_cameras, load_trajectory
from fidsplat.scenes.scene import Scene
from fidsplat.scenes.up import sampled
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.statistics import guess_up, level_rotation
from fidsplat.store.layout import SUFFIX
from fidsplat.store.store import Store
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of
from fidsplat.util.progress import Progress

WIDTH, HEIGHT, FOV_X = 1280, 720, math.radians(60.0)
ELEVATION = math.radians(15.0)
MARGIN = 1.1
REACH = 1.5
"""extent of the framed splats in standard deviations; with 3, faint tails would determine the distance"""
MANY = 10_000
"""number of splats from which a cloud is framed without its outermost 1 %, as captures have outliers"""


@dataclass(frozen=True)
class StartPose:
    """Pose of the camera: options of commands that render one view."""

    up: tuple[float, float, float] | None = None
    """X Y Z: direction that points up in the image (default: the camera's; for a splat file, the estimate of
    `fidsplat info`)"""
    position: tuple[float, float, float] | None = None
    """X Y Z: centre of projection in metres (default: the camera's)"""
    look_at: tuple[float, float, float] | None = None
    """X Y Z: point in the middle of the image (default: in the camera's direction; for a splat file, the
    middle of the scene)"""

    def __post_init__(self) -> None:
        for name in ("up", "position", "look_at"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value).all() and (np.any(value) or name != "up")):
                requirement = "three finite numbers" + (", not all 0" if name == "up" else "")
                raise InputError(f"camera {name} must be {requirement}, got {value}")

    def applied(self, camera: Camera, middle=None) -> Camera:
        """The camera at this pose. middle: (3,) default of `look_at`; None: in the camera's direction."""
        if self == OWN_POSE:
            return camera
        rotation = camera.world_to_camera[:3, :3]
        position = camera.position if self.position is None else self.position
        target = middle if self.look_at is None else self.look_at
        target = np.add(position, rotation[2]) if target is None else target
        return camera.with_pose(
            position=position, target=target, up=-rotation[1] if self.up is None else self.up
        )


OWN_POSE = StartPose()
"""pose that keeps the camera"""


def load_source(
    source: str,
    quality: Quality | str | None = None,
    progress: Progress | None = None,
    pose: StartPose = OWN_POSE,
    size: tuple[int, int] | None = None,
) -> Scene:
    """Load a scene file, or a splat file or store with a camera that frames it.

    pose, size: pose and (width, height) in pixels that replace those of the camera.

    Raises:
        InputError: a file of another format; a scene without a camera.
    """
    suffix = Path(source).suffix.lower()
    if suffix == ".toml":
        scene = Scene.load(source, quality, progress)
        if scene.camera is None:
            raise InputError(
                f"{source} must have a [camera] table, got none; add one with width, height, fov_x_deg, "
                "position, look_at"
            )
        camera = scene.camera if size is None else scene.camera.with_size(*size)
        if pose != OWN_POSE:  # replaces the motion of the camera
            camera = scene.capture.motion.moved(camera, scene.capture.shutter.time)
            scene = replace(scene, camera_motion=None)
        return replace(scene, camera=pose.applied(camera))
    if suffix == SUFFIX:
        store = Store(source)
        return Scene(stores=(store,), camera=framing_camera(store, pose, size))
    if suffix in FORMATS or Path(source).name.lower() in NAMED:
        cloud = load_splats(source, progress)
        return Scene((cloud,), camera=framing_camera(cloud, pose, size))
    raise InputError(
        f"the source must be a scene file (.toml), a store ({SUFFIX}) or a splat file "
        f"({', '.join([*FORMATS, *NAMED])}), got {source}{remedy_for(path_of(source))}"
    )


def framing_camera(
    cloud: SplatCloud | Store, pose: StartPose = OWN_POSE, size: tuple[int, int] | None = None
) -> Camera:
    """A camera with all splats in its field of view of 60 degrees, by default 1280 x 720 pixels.

    The vertical of the scene points up in the image, and x to the right, if possible. The camera looks down
    by 15 degrees if `pose` gives the vertical or horizontal surfaces determine it, and else horizontally.
    """
    width, height = (WIDTH, HEIGHT) if size is None else size
    guess = guess_up(sampled(cloud))
    up = guess.direction if pose.up is None else np.array(pose.up)
    low, high = _extent(cloud)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    ahead = level_rotation(up)[:, 2]
    if guess.ground or pose.up is not None:
        ahead = ahead - math.tan(ELEVATION) * up / np.linalg.norm(up)
    start = Camera.look_at(width, height, FOV_X, middle - ahead, middle, up)
    corners = half * np.stack(np.meshgrid(*([-1, 1],) * 3), -1).reshape(-1, 3)
    corners = corners @ start.world_to_camera[:3, :3].T
    tangent = math.tan(FOV_X / 2) * np.array([1.0, height / width])
    distance = (MARGIN * np.abs(corners[:, :2]) / tangent - corners[:, 2:]).max()
    position = middle - distance * start.world_to_camera[2, :3]
    camera = Camera.look_at(width, height, FOV_X, position, middle, up, near=min(0.01, distance / 100))
    return pose.applied(camera, middle)


def _extent(cloud: SplatCloud | Store) -> tuple[np.ndarray, np.ndarray]:
    if len(cloud) == 0:
        return -np.ones(3), np.ones(3)
    if isinstance(
        cloud, Store
    ):  # by the bounding boxes of its chunks, which are small compared with the scene
        return cloud.bounds(REACH)
    half_extents = cloud.half_extents(REACH)
    percent = 0.5 if len(cloud) >= MANY else 0.0
    low = np.percentile(cloud.means - half_extents, percent, axis=0)
    high = np.percentile(cloud.means + half_extents, 100 - percent, axis=0)
    return low + cloud.origin, high + cloud.origin


def cameras_of(path: str | os.PathLike[str], scene: Scene) -> list[Camera]:
    """Cameras of a COLMAP model or transforms.json, or the scene's camera at the poses of a trajectory.

    Raises:
        InputError: an unreadable file; a trajectory for a scene without a camera.
    """
    file = path_of(path)
    if file.is_dir() or file.suffix.lower() == ".json":
        return list(load_cameras(file).values())
    if scene.camera is None:
        raise InputError(f"the scene of the trajectory {file} must have a camera, got none")
    camera = scene.camera
    return [camera.with_pose(camera_to_world=pose) for pose in load_trajectory(file).poses]
