"""Training data set: images with their cameras, and initial points."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.train.random_numbers import RandomStream, uniform
from fidsplat.util.arguments import instance, invalid, items, real_array, text, three_numbers, whole_number
from fidsplat.util.errors import InputError

DRAW_MASK = "draw the mask on this image, as undistortion and reduction move its pixels"
"""remedy for a mask of another size"""
FAR = 1e4
"""distance from the world origin, in scene extents, beyond which means are stored relative to a nearer
origin, to avoid rounding errors of float32"""
_FACING = 0.5
"""minimum cosine between the optical axis of a camera and the direction to a point that the camera faces"""
_RANDOM_DEPTH = 3.0
"""maximum depth of random points in frustums, in scene extents"""
MAX_POINTS = 2**31 - 1
_MIN_EXTENT = 1e-9
"""minimum scene extent relative to the distance from the world origin; below, it may be rounding error"""


@dataclass(frozen=True, eq=False)
class TrainingView:
    """One image with its camera."""

    name: str
    camera: Camera
    image: np.ndarray
    """(h, w, 3) uint8 display values"""
    mask: np.ndarray | None = None
    """(h, w) bool, False for ignored pixels"""
    background: tuple[float, float, float] | None = None
    """background colour of this view, display values; None: the data set's"""

    def __post_init__(self) -> None:
        text("the name of a training view", self.name)
        instance(f"the camera of {self.name}", self.camera, Camera)
        instance(f"the image {self.name}", self.image, np.ndarray, "an array (h, w, 3) of uint8")
        camera, shape = self.camera, self.image.shape
        if self.image.dtype != np.uint8 or shape != (camera.height, camera.width, 3):
            size = f"{shape[1]} x {shape[0]}" if len(shape) >= 2 else f"the shape {shape}"
            raise InputError(
                f"the image {self.name} must be {camera.width} x {camera.height} pixels of uint8, the "
                f"size of its camera, got {size}; give images of the size for which their cameras were found"
            )
        mask = self.mask
        if mask is not None and not (isinstance(mask, np.ndarray) and mask.dtype == bool and mask.ndim == 2):
            raise invalid(f"the mask of {self.name}", "an array (h, w) of bool, or None", mask)
        if self.mask is not None and self.mask.shape != shape[:2]:
            raise InputError(
                f"the mask of {self.name} must be {shape[1]} x {shape[0]}, the size of its image, got "
                f"{self.mask.shape[1]} x {self.mask.shape[0]}; {DRAW_MASK}"
            )
        if camera.lens is not None:
            raise InputError(
                f"the camera of {self.name} must be a pinhole camera, got a lens ({camera.lens.kind}); "
                "undistort the image first"
            )


@dataclass(frozen=True, eq=False)
class Dataset:
    """Training views, held-out views and initial points, checked when created.

    Raises:
        InputError: fewer than two views, all cameras at one position, or all points behind a camera.
    """

    name: str
    """source, shown in messages"""
    views: tuple[TrainingView, ...]
    held_out: tuple[TrainingView, ...]
    """views for evaluation only"""
    points: np.ndarray
    """(m, 3) float64, world coordinates [m]"""
    colors: np.ndarray
    """(m, 3) uint8"""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """background colour, display values"""
    boxes: tuple[np.ndarray, ...] = ()
    """(4, 4) matrices from the cube [-1, 1]^3 to boxes of markers, in which trained splats are removed"""

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
        boxes = [real_array(f"a box of {self.name}", box) for box in self.boxes]
        if not all(box.shape == (4, 4) and np.linalg.matrix_rank(box) == 4 for box in boxes):
            raise invalid(f"a box of {self.name}", "an invertible matrix (4, 4)", self.boxes)
        object.__setattr__(self, "boxes", tuple(boxes))
        if len(self.views) < 2:
            raise InputError(
                f"{self.name} must have at least two training views, from different positions, got "
                f"{len(self.views)}"
            )
        if not self.extent > _MIN_EXTENT * max(np.abs(view.camera.position).max() for view in self.views):
            raise InputError(
                f"the {len(self.views)} cameras of {self.name} must be at different positions, got one "
                "position, from which depths cannot be determined; give views from different positions"
            )
        if wrong := np.count_nonzero(~np.isfinite(self.points).all(axis=-1)):
            raise InputError(
                f"the points of {self.name} must be finite, got {wrong:,} others; export the model again"
            )
        for view in self.views if len(self.points) else ():
            if not (depths(view.camera, self.points) > view.camera.near).any():
                raise InputError(
                    f"points of {self.name} must be in front of the camera of {view.name}, got all "
                    f"{len(self.points)} behind it; check that poses and points are of one model, and the "
                    "pose convention (COLMAP: world to camera; transforms.json: camera to world, looking "
                    "along -z)"
                )

    @cached_property
    def extent(self) -> float:
        """Scene extent [m]: 1.1 times the largest distance of a camera from their mean, as in 2DGS."""
        centers = np.array([view.camera.position for view in self.views])
        return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) float64: origin of the splats' means; not 0 in scenes far from the world origin."""
        center = np.mean([view.camera.position for view in self.views], axis=0)
        return np.rint(center) if np.abs(center).max() > FAR * self.extent else np.zeros(3)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of all inputs of training."""
        sha = hashlib.sha256(json.dumps(self.background).encode())

        def update(*arrays: np.ndarray | None) -> None:
            for array in arrays:
                # with type and shape, so that a mask and an image of equal bytes differ
                sha.update(b"-" if array is None else f"{array.dtype.str} {array.shape}".encode())
                sha.update(b"" if array is None else np.ascontiguousarray(array).tobytes())

        for view in self.views:
            camera = view.camera
            lens = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
            sha.update(json.dumps([view.name, *lens, camera.near, camera.far]).encode())
            update(camera.world_to_camera, view.image, view.mask)
            if view.background is not None:
                sha.update(json.dumps(view.background).encode())
        update(self.points, self.colors)
        return sha.hexdigest()

    def with_random_points(self, count: int, seed: int) -> Dataset:
        """The data set with random points of random colours, in the cube that most cameras face, or else in
        the cameras' frustums up to a depth of three scene extents."""
        count = whole_number("the number of random points", count, 0, MAX_POINTS)
        seed = whole_number("the seed", seed, 0, 2**63 - 1)
        cameras, draws = [view.camera for view in self.views], uniform(seed, RandomStream.POINTS, 0, count)
        shades = uniform(seed, RandomStream.POINTS, 0, count, draw=1)
        low, high, faced = viewed_cube(cameras)
        if faced:
            points = low + draws[:, :3] * (high - low)
        else:
            points = _points_in_frustums(cameras, draws[:, :3], _RANDOM_DEPTH * self.extent)
        return replace(self, points=points, colors=(shades[:, :3] * 256).astype(np.uint8))


def viewed_cube(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Cube around the point nearest to all optical axes, as large as the field of view there.

    Returns its minimum and maximum corners (3,), and whether most cameras face it.
    """
    centers = np.array([camera.position for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    # for parallel axes this is the least-norm solution relative to the mean camera position
    middle = centers.mean(0)
    shift = np.linalg.lstsq(across.sum(0), np.einsum("nij,nj->i", across, centers - middle), rcond=1e-6)[0]
    focus = middle + shift
    distances = np.linalg.norm(focus - centers, axis=1)
    reach = np.mean(
        [
            far * max(camera.width / camera.fx, camera.height / camera.fy) / 2
            for far, camera in zip(distances, cameras, strict=True)
        ]
    )
    along = np.einsum("ni,ni->n", axes, focus - centers)
    return focus - reach, focus + reach, bool(along.mean() > _FACING * distances.mean())


def _points_in_frustums(cameras: Sequence[Camera], random_numbers: np.ndarray, depth: float) -> np.ndarray:
    """Points (n, 3) in the frustums of the cameras, round robin, up to a depth [m].

    random_numbers: (n, 3) in (0, 1).
    """
    points = np.empty(random_numbers.shape)
    for number, camera in enumerate(cameras):
        mine = random_numbers[number :: len(cameras)]
        rays = camera.rays(mine[:, :2] * (camera.width, camera.height)) * (mine[:, 2:] * depth)
        points[number :: len(cameras)] = camera.position + rays @ camera.world_to_camera[:3, :3]
    return points


def depths(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Depths (n,) [m] of world points (n, 3) along the optical axis."""
    return (points - camera.position) @ camera.world_to_camera[2, :3]
