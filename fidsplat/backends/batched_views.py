"""Views that are rendered together in one batch, with their uniforms in stacked arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fidsplat.backends.view import FAR_EYE, View, moved_pose, rotated

_SHARED = (
    *("width", "height", "samples", "sensor", "background", "fog_density", "environment_map"),
    *("log_alpha_cutoff", "opacity_ceiling", "transmittance_stop", "first_hit_transmittance"),
    *("external_depth", "along_ray", "parallel"),
)
_PER_VIEW = ("focal_x", "focal_y", "center_x", "center_y", "near", "far", "ewa_clamp")
_INDEX_0 = np.zeros(1, np.uint32)
_INDEX_0.flags.writeable = False


@dataclass(frozen=True, eq=False)
class ViewBatch:
    """Views of one size that are rendered together; a single view is a batch of one.

    v of `total` views are rendered; the others are masked out. Splats with the labels in `view.groups` have
    their own poses, one for each of g groups. Index 0 of the pose arrays is for all other splats.
    """

    view: View
    """the first view; its values hold for all views unless a field below replaces them"""
    rotation: np.ndarray
    """(g + 1, v, 3, 3) float64, world to camera"""
    translation: np.ndarray
    """(g + 1, v, 3) float64 metres"""
    eye: np.ndarray
    """(g + 1, v, 3) float64 metres"""
    camera_parameters: Mapping[str, np.ndarray] = field(default_factory=dict)
    """(v,) or (v, k) float64: camera parameters that differ between views, by their names in View"""
    batch_indices: np.ndarray = field(default_factory=lambda: _INDEX_0)
    """(v,) uint32: position of each view in the batch"""
    total: int = 1
    views: tuple[View, ...] = ()
    """the rendered views; empty for a batch of poses (`of_poses`), where `view_at` makes them"""
    same_uniforms: bool = True
    """whether the views differ only in poses and `camera_parameters`; if not, they are rendered one by one"""

    def __len__(self) -> int:
        return len(self.batch_indices)

    @property
    def is_single(self) -> bool:
        """Whether the batch has only one view."""
        return self.total == 1 == len(self)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of pixels."""
        return self.view.height // self.view.samples, self.view.width // self.view.samples

    @staticmethod
    def single(view: View) -> ViewBatch:
        """A batch of one view."""
        if view.groups:
            return _stack((view,), {}, _INDEX_0, 1)
        poses = view.rotation[None, None], view.translation[None, None], view.eye[None, None]
        return ViewBatch(view, *poses, batch_indices=_INDEX_0, views=(view,))

    @staticmethod
    def of(views: Sequence[View], batch_indices: np.ndarray, total: int) -> ViewBatch:
        """A batch of v views. batch_indices: (v,) uint32. total: number of views, including masked views."""
        first = views[0]
        labels = [label for label, _ in first.groups]
        for view in views:
            same = all(getattr(view, name) == getattr(first, name) for name in _SHARED)
            same = same and view.raster is first.raster and not view.sub_frames
            if not same or [label for label, _ in view.groups] != labels:
                return replace(
                    ViewBatch.single(first),
                    batch_indices=batch_indices,
                    total=total,
                    views=tuple(views),
                    same_uniforms=False,
                )
        camera_parameters = {
            name: np.array([getattr(view, name) for view in views], np.float64) for name in _PER_VIEW
        }
        camera_parameters = {
            name: values for name, values in camera_parameters.items() if (values != values[0]).any()
        }
        return _stack(views, camera_parameters, batch_indices, total)

    @staticmethod
    def of_poses(
        view: View,
        origin: np.ndarray,
        poses: np.ndarray | None,
        groups: Mapping[int, np.ndarray],
        batch_indices: np.ndarray,
        total: int,
    ) -> ViewBatch:
        """A batch of one camera in v poses, bit-identical to a `View.of` for each pose. origin: (3,) origin
        of the cloud. poses: (v, 4, 4) camera to world; None: the pose of `view`. groups: (v, 4, 4) motion of
        each group in world coordinates, by label."""
        count = len(batch_indices)
        if poses is None:
            rotation = np.broadcast_to(view.rotation, (count, 3, 3))
            translation = np.broadcast_to(view.translation, (count, 3))
            eye = np.broadcast_to(view.eye, (count, 3))
        else:
            world_to_camera = np.zeros((count, 4, 4))
            world_to_camera[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
            rotation = world_to_camera[:, :3, :3]
            centre = poses[:, :3, 3] - origin
            translation = rotated(-rotation, centre)
            eye = centre - FAR_EYE * rotation[:, 2] if view.parallel else centre
        rotations, translations, eyes = [rotation], [translation], [eye]
        for motion in groups.values():
            moved = moved_pose(rotation, translation, motion, origin, view.parallel)
            for stack, array in zip((rotations, translations, eyes), moved, strict=True):
                stack.append(array)
        arrays = np.stack(rotations), np.stack(translations), np.stack(eyes)
        return ViewBatch(view, *arrays, batch_indices=batch_indices, total=total)

    def sub_batch(self, first: int, end: int) -> ViewBatch:
        """The batch of the rendered views [first, end) alone."""
        indices = self.batch_indices[first:end].copy()
        if end - first == 1:
            return replace(ViewBatch.single(self.view_at(first)), batch_indices=indices, total=self.total)
        external = self.view.external_depth
        return ViewBatch(
            replace(self.view, external_depth=external.of_views(slice(first, end)))
            if external and external.stacked
            else self.view,
            self.rotation[:, first:end],
            self.translation[:, first:end],
            self.eye[:, first:end],
            {name: values[first:end] for name, values in self.camera_parameters.items()},
            indices,
            self.total,
            self.views[first:end],
        )

    def view_at(self, number: int) -> View:
        """One of the rendered views, by its number."""
        if self.views:
            return self.views[number]
        uniforms: dict[str, Any] = {
            name: _as_python(values[number]) for name, values in self.camera_parameters.items()
        }
        external = self.view.external_depth
        if external and external.stacked:
            uniforms["external_depth"] = external.of_views(number)

        def at(view: View, group: int) -> View:
            arrays = {name: getattr(self, name)[group, number] for name in ("rotation", "translation", "eye")}
            return replace(view, **uniforms, **arrays)

        groups = tuple((label, at(view, k + 1)) for k, (label, view) in enumerate(self.view.groups))
        return replace(at(self.view, 0), groups=groups)


def _stack(
    views: Sequence[View], camera_parameters: Mapping[str, np.ndarray], batch_indices: np.ndarray, total: int
) -> ViewBatch:
    groups_of_views = [[view, *(moved for _, moved in view.groups)] for view in views]
    rotation, translation, eye = (
        np.stack([[getattr(group, name) for group in groups] for groups in groups_of_views], axis=1)
        for name in ("rotation", "translation", "eye")
    )
    return ViewBatch(
        views[0], rotation, translation, eye, camera_parameters, batch_indices, total, views=tuple(views)
    )


def _as_python(value: np.ndarray) -> float | tuple[float, ...]:
    return tuple(value.tolist()) if value.ndim else float(value)
