"""Many views of one size in one: their uniforms stacked, for pictures that are drawn together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fidsplat.backends.view import FAR_EYE, View

_SHARED = (
    *("width", "height", "samples", "log_cut", "ceiling", "stop", "background", "first_light", "sensor"),
    *("fog_density", "surroundings", "external_depth", "along_ray", "parallel"),
)
_OWN = ("focal_x", "focal_y", "center_x", "center_y", "near", "far", "slopes")


@dataclass(frozen=True)
class ViewBatch:
    """What a backend is asked to draw of a batch."""

    views: Sequence[View] | ViewStack
    """those that are drawn, stacked where they have enough in common"""
    slots: np.ndarray
    """(views drawn,) uint32: which of the batch each is"""
    total: int
    """views of the batch, those that are masked out among them"""
    size: tuple[int, int]
    """rows and columns of pixels"""

    def one(self, number: int) -> View:
        """A view that is drawn."""
        return self.views.one(number) if isinstance(self.views, ViewStack) else self.views[number]

    def part(self, first: int, end: int) -> ViewStack:
        """Views [first, end) that are drawn, which are stacked unless it is one."""
        if isinstance(self.views, ViewStack) and end - first > 1:
            return self.views.part(first, end)
        return ViewStack.alone(self.one(first))


@dataclass(frozen=True)
class ViewStack:
    """Views that differ in where cameras and groups of splats are, and perhaps in a camera's own numbers.

    g groups of splats move by themselves, those of the labels of `view.groups`; index 0 is all that stands.
    """

    view: View
    """the first, which has all that they have in common"""
    rotation: np.ndarray
    """(g + 1, views, 3, 3) float64, world to camera"""
    translation: np.ndarray
    """(g + 1, views, 3) float64 metres"""
    eye: np.ndarray
    """(g + 1, views, 3) float64 metres"""
    numbers: Mapping[str, np.ndarray] = field(default_factory=dict)
    """(views,) or (views, k) float64 by the name in View: of the camera's own numbers those that differ"""

    def __len__(self) -> int:
        """Views."""
        return self.translation.shape[1]

    @staticmethod
    def of(views: Sequence[View]) -> ViewStack | None:
        """The views as a stack; None if they have too little in common, or one is made of several poses."""
        first = views[0]
        labels = [label for label, _ in first.groups]
        for view in views:
            alike = all(getattr(view, name) == getattr(first, name) for name in _SHARED)
            alike = alike and view.raster is first.raster and not view.sub_frames
            if not alike or [label for label, _ in view.groups] != labels:
                return None
        numbers = {name: np.array([getattr(view, name) for view in views], np.float64) for name in _OWN}
        return ViewStack._of(views, {name: each for name, each in numbers.items() if (each != each[0]).any()})

    @staticmethod
    def alone(view: View) -> ViewStack:
        """A stack of one."""
        if view.groups:
            return ViewStack._of([view], {})
        return ViewStack(view, view.rotation[None, None], view.translation[None, None], view.eye[None, None])

    @staticmethod
    def _of(views: Sequence[View], numbers: Mapping[str, np.ndarray]) -> ViewStack:
        own = [[view, *(moved for _, moved in view.groups)] for view in views]

        def stacked(name: str) -> np.ndarray:
            return np.stack([[getattr(group, name) for group in each] for each in own], axis=1)

        return ViewStack(views[0], stacked("rotation"), stacked("translation"), stacked("eye"), numbers)

    @staticmethod
    def of_poses(
        view: View,
        origin: np.ndarray,
        poses: np.ndarray | None,
        groups: Mapping[int, np.ndarray],
        count: int,
    ) -> ViewStack:
        """A view from many places: what `View.of` and motions make of each, bit for bit.

        Args:
            view: one of them.
            origin: (3,) of the cloud.
            poses: (count, 4, 4) camera to world; None: all where `view` is.
            groups: label, in their order: (count, 4, 4) motion of the world.
        """
        if poses is None:
            rotation = np.broadcast_to(view.rotation, (count, 3, 3))
            translation = np.broadcast_to(view.translation, (count, 3))
            eye = np.broadcast_to(view.eye, (count, 3))
        else:
            world_to_camera = np.zeros((count, 4, 4))
            world_to_camera[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
            rotation = world_to_camera[:, :3, :3]
            centre = poses[:, :3, 3] - origin
            translation = _applied(-rotation, centre)
            eye = centre - FAR_EYE * rotation[:, 2] if view.parallel else centre
        rotations, translations, eyes = [rotation], [translation], [eye]
        for motion in groups.values():
            turn, move = motion[:, :3, :3], motion[:, :3, 3]
            turned = rotation @ turn
            away = _applied(turn, np.broadcast_to(origin, (count, 3))) + move - origin
            moved = translation + _applied(rotation, away)
            own = _applied(-np.swapaxes(turned, 1, 2), moved)
            rotations.append(turned)
            translations.append(moved)
            eyes.append(own - FAR_EYE * turned[:, 2] if view.parallel else own)
        return ViewStack(view, np.stack(rotations), np.stack(translations), np.stack(eyes))

    def part(self, first: int, end: int) -> ViewStack:
        """Views [first, end)."""
        return ViewStack(
            self.view,
            self.rotation[:, first:end],
            self.translation[:, first:end],
            self.eye[:, first:end],
            {name: each[first:end] for name, each in self.numbers.items()},
        )

    def one(self, number: int) -> View:
        """A view alone."""
        own = {name: _plain(each[number]) for name, each in self.numbers.items()}

        def at(view: View, group: int) -> View:
            arrays = {name: getattr(self, name)[group, number] for name in ("rotation", "translation", "eye")}
            return replace(view, **own, **arrays)

        groups = tuple((label, at(view, k + 1)) for k, (label, view) in enumerate(self.view.groups))
        return replace(at(self.view, 0), groups=groups)


def _applied(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Of each matrix (n, 3, 3) with its vector (n, 3), as `matrix @ vector` rounds it."""
    return (matrices @ vectors[..., None])[..., 0]


def _plain(value: np.ndarray) -> float | tuple[float, ...]:
    return tuple(value.tolist()) if value.ndim else float(value)
