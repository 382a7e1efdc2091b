"""A data set to train on: pictures with their cameras, points to start from."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.environment import three_numbers
from fidsplat.train.random_numbers import Purpose, uniform
from fidsplat.util.arguments import instance, invalid, items, text, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.scalars import real_array

FAR = 1e4
"""extents from the world's origin beyond which means have an origin of their own: float32 would blur them"""
_FACING, _AHEAD = 0.5, 3.0
"""cosine from which cameras look at a point; extents, to which they see where they look at none"""
MOST_POINTS = 2**31 - 1
_STILL = 1e-9
"""share of a camera's distance from the world's origin, below which movements are what rounding leaves"""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One picture and where it was taken."""

    name: str
    camera: Camera
    picture: np.ndarray
    """(h, w, 3) uint8 display values"""
    mask: np.ndarray | None = None
    """(h, w) bool, False where the picture does not matter"""

    def __post_init__(self) -> None:
        text("the name of a training view", self.name)
        instance(f"the camera of {self.name}", self.camera, Camera)
        instance(f"the picture {self.name}", self.picture, np.ndarray, "an array (h, w, 3) of uint8")
        camera, shape = self.camera, self.picture.shape
        if self.picture.dtype != np.uint8 or shape != (camera.height, camera.width, 3):
            size = f"{shape[1]} x {shape[0]}" if len(shape) >= 2 else f"of the shape {shape}"
            raise InputError(
                f"the picture {self.name} is {size}, but its camera has {camera.width} x {camera.height} "
                "pixels; give pictures of the size that their cameras were found for"
            )
        mask = self.mask
        if mask is not None and not (isinstance(mask, np.ndarray) and mask.dtype == bool and mask.ndim == 2):
            raise invalid(f"the mask of {self.name}", "an array (h, w) of bool, or None", mask)
        if self.mask is not None and self.mask.shape != shape[:2]:
            raise InputError(
                f"the mask of {self.name} is {self.mask.shape[1]} x {self.mask.shape[0]}, its picture "
                f"{shape[1]} x {shape[0]}; make them of one size"
            )
        if camera.lens is not None:
            raise InputError(
                f"the camera of {self.name} has a lens ({camera.lens.kind}), and pictures are trained on "
                "without; undistort them first"
            )


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views to train on, views to compare with, and points to start from. Checked when it is made.

    Raises:
        InputError: fewer than two views, cameras that all stand at one place, points that no view sees.
    """

    name: str
    """where it comes from, for messages"""
    views: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]
    """views that are not trained on"""
    points: np.ndarray
    """(m, 3) float64, metres, in the world"""
    colors: np.ndarray
    """(m, 3) uint8"""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """display values behind everything"""

    def __post_init__(self) -> None:
        text("the name of a data set", self.name)
        for name in ("views", "held_out"):
            views = items(f"{name} of {self.name}", getattr(self, name), TrainingView, "TrainingViews")
            object.__setattr__(self, name, views)
        points = real_array(f"the points of {self.name}", self.points)
        if points.ndim != 2 or points.shape[1] != 3:
            raise invalid(f"the points of {self.name}", "an array (m, 3)", self.points)
        colors = self.colors
        if not isinstance(colors, np.ndarray) or colors.dtype != np.uint8 or colors.shape != points.shape:
            raise invalid(f"the colours of {self.name}", f"an array {points.shape} of uint8", colors)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "background", three_numbers("background", self.background))
        if len(self.views) < 2:
            raise InputError(
                f"{self.name} has {len(self.views)} view{'' if len(self.views) == 1 else 's'} to train on; a "
                "scene needs at least two, from different places"
            )
        if not self.extent > _STILL * max(np.abs(view.camera.position).max() for view in self.views):
            raise InputError(
                f"all {len(self.views)} cameras of {self.name} stand at one place, from which no depth can "
                "be told; give views from different places"
            )
        if len(self.points) and not np.isfinite(self.points).all():
            raise InputError(f"points of {self.name} are not finite; export the model again")
        for view in self.views if len(self.points) else ():
            if not (_depths(view.camera, self.points) > view.camera.near).any():
                raise InputError(
                    f"all {len(self.points)} points of {self.name} lie behind the camera of {view.name}; "
                    "check that poses and points are of one model, and poses of the convention that the "
                    "format has (COLMAP: world to camera; transforms.json: camera to world, looking along -z)"
                )

    @cached_property
    def extent(self) -> float:
        """Metres: 1.1 times the largest distance of a camera from their mean, as the authors' trainer has
        it."""
        centers = np.array([view.camera.position for view in self.views])
        return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) float64: what the splats' means are relative to; 0 but for scenes far from it."""
        center = np.mean([view.camera.position for view in self.views], axis=0)
        return np.rint(center) if np.abs(center).max() > FAR * self.extent else np.zeros(3)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all that training depends on."""
        found = hashlib.sha256(json.dumps(self.background).encode())

        def update(*arrays: np.ndarray | None) -> None:
            for array in arrays:  # with types and shapes: a mask is never taken for part of a picture
                found.update(b"-" if array is None else f"{array.dtype.str} {array.shape}".encode())
                found.update(b"" if array is None else np.ascontiguousarray(array).tobytes())

        for view in self.views:
            camera = view.camera
            lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            found.update(json.dumps([view.name, *lens, camera.near, camera.far]).encode())
            update(camera.world_to_camera, view.picture, view.mask)
        update(self.points, self.colors)
        return found.hexdigest()

    def with_random_points(self, count: int, seed: int) -> Dataset:
        """The data set with points at random places, in random colours, where its cameras look: in a cube,
        or, where most of them look ahead or around, before each to three extents."""
        count = whole_number("the number of random points", count, 0, MOST_POINTS)
        seed = whole_number("the seed", seed, 0, 2**63 - 1)
        cameras, draws = [view.camera for view in self.views], uniform(seed, Purpose.POINTS, 0, count)
        shades = uniform(seed, Purpose.POINTS, 0, count, draw=1)
        low, high, faced = looked_at(cameras)
        if faced:
            points = low + draws[:, :3] * (high - low)
        else:
            points = _before(cameras, draws[:, :3], _AHEAD * self.extent)
        return replace(self, points=points, colors=(shades[:, :3] * 256).astype(np.uint8))


def looked_at(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Corners (3,), (3,) of the cube around the point that is nearest to the axes of all cameras, as large as
    they see there; and whether it lies before most of them."""
    centers = np.array([camera.position for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # of parallel axes the shortest solution, from their middle
    middle = centers.mean(0)
    shift = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers - middle), rcond=1e-6)[0]
    focus = middle + shift
    away = np.linalg.norm(focus - centers, axis=1)
    reach = np.mean(
        [
            far * max(camera.width / camera.fx, camera.height / camera.fy) / 2
            for far, camera in zip(away, cameras, strict=True)
        ]
    )
    along = np.einsum("ni,ni->n", axes, focus - centers)
    return focus - reach, focus + reach, bool(along.mean() > _FACING * away.mean())


def _before(cameras: Sequence[Camera], draws: np.ndarray, reach: float) -> np.ndarray:
    """Points (n, 3) in what the cameras see, in turn, at depths up to a reach; draws: (n, 3) in (0, 1)."""
    points = np.empty(draws.shape)
    for number, camera in enumerate(cameras):
        mine = draws[number :: len(cameras)]
        rays = camera.rays(mine[:, :2] * (camera.width, camera.height)) * (mine[:, 2:] * reach)
        points[number :: len(cameras)] = camera.position + rays @ camera.world_to_camera[:3, :3]
    return points


def _depths(camera: Camera, points: np.ndarray) -> np.ndarray:
    return (points - camera.position) @ camera.world_to_camera[2, :3]
