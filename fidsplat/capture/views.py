"""Views of a batch: captures of one size, with poses of the cameras and of groups of splats."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fidsplat.cameras import Camera, Motion
from fidsplat.capture.capture import Capture
from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.util.arguments import LARGEST, array_of, real_array
from fidsplat.util.errors import InputError


@dataclass(frozen=True)
class CaptureBatch:
    """Batch of v views: captures, and poses that replace poses of the captures."""

    captures: tuple[Capture, ...]
    """one for each view, or one for all"""
    poses: np.ndarray | None = None
    """(v, 4, 4) float64 camera to world, rigid; None: the poses of the captures' cameras"""
    groups: Mapping[int, np.ndarray] | None = None
    """label: (v, 4, 4) float64, rigid world transforms of the label's splats"""
    mask: np.ndarray | None = None
    """(v,) bool: views to render; None: all"""

    def __post_init__(self) -> None:
        counts = self._counts | ({} if self.mask is None else {"mask": len(self.mask)})
        if len(set(counts.values())) > 1:
            listed = ", ".join(f"{name} has {count}" for name, count in counts.items())
            raise InputError(f"all arguments of a batch must have the same number of views, got {listed}")
        if not len(self):
            raise InputError(f"a batch must have at least one view, got an empty {next(iter(counts))}")
        for number, capture in enumerate(self.captures):
            self._check_motion(number, capture.motion)

    @cached_property
    def _counts(self) -> dict[str, int]:
        """Number of views by the name of each argument that determines it."""
        counts = {"captures": len(self.captures)} if len(self.captures) != 1 else {}
        counts |= {} if self.poses is None else {"poses": len(self.poses)}
        counts |= {f"groups[{label}]": len(poses) for label, poses in (self.groups or {}).items()}
        for external in (capture.external_depth for capture in self.captures):
            if external and external.stacked:
                counts["external_depth"] = len(external.depth)
        return counts or {"captures": 1}

    def _check_motion(self, number: int, motion: Motion) -> None:
        if self.poses is not None and motion.camera is not None:
            raise InputError(
                f"the camera of view {number} must be moved by poses or by its motion, got both; omit one"
            )
        for label in self.groups or ():
            if label in motion.groups:
                raise InputError(
                    f"the splats of label {label} in view {number} must be moved by groups or by the view's "
                    "motion, got both; omit one"
                )

    def __len__(self) -> int:
        """Number of views, including masked views."""
        return next(iter(self._counts.values()))

    @property
    def active(self) -> list[int]:
        """Indices of the views to render."""
        return list(range(len(self))) if self.mask is None else np.flatnonzero(self.mask).tolist()

    def capture(self, number: int) -> Capture:
        """Capture of one view, which renders bit-identically to this view of the batch."""
        base = self.captures[number if len(self.captures) > 1 else 0]
        camera, motion = base.camera, base.motion
        if base.external_depth and base.external_depth.stacked:
            base = base.with_(external_depth=base.external_depth.of_views(number))
        if self.poses is not None and camera is not None:
            camera = camera.with_pose(camera_to_world=self.poses[number])
        if self.groups:
            moved = {label: _constant(poses[number]) for label, poses in self.groups.items()}
            motion = Motion(motion.camera, {**motion.groups, **moved})
        unchanged = camera is base.camera and motion is base.motion
        return base if unchanged else base.with_(camera=camera, motion=motion)

    def check_sizes(self) -> None:
        """Raise InputError if captures differ in size or outputs."""
        first = self.captures[0]
        for number, capture in enumerate(self.captures[1:], 1):
            for what, expected, value in (
                ("size", _size(first.camera), _size(capture.camera)),
                ("outputs", first.outputs, capture.outputs),
            ):
                if expected != value:
                    raise InputError(
                        f"the views of a batch must have the same {what}, got {expected} for view 0 and "
                        f"{value} for view {number}; render them in separate batches"
                    )


def capture_batch(
    captures: Iterable[Capture], poses: Any = None, groups: Any = None, mask: Any = None
) -> CaptureBatch:
    """Validated batch of captures, from the arguments of `Renderer.render_batch`."""
    if groups is not None and not isinstance(groups, Mapping):
        raise InputError(f"groups must be {{label: poses (views, 7)}}, got {groups!r}")
    for label in groups or ():
        if isinstance(label, bool) or not isinstance(label, (int, np.integer)):
            raise InputError(f"keys of groups must be integer labels, got {label!r}")
    moved = {int(label): pose_matrices(f"groups[{label}]", array) for label, array in (groups or {}).items()}
    if mask is not None:
        mask = array_of("mask", mask, "(views,) bools", "b")
        if mask.ndim != 1:
            raise InputError(f"mask must be (views,) bools, got the shape {mask.shape}")
    matrices = None if poses is None else pose_matrices("poses", poses)
    views = CaptureBatch(tuple(captures), matrices, moved or None, mask)
    views.check_sizes()
    return views


def pose_matrices(name: str, poses: Any) -> np.ndarray:
    """Rigid matrices (v, 4, 4) float64 of poses (v, 7): x y z in metres, and a quaternion w x y z of any
    non-zero length."""
    vectors = real_array(name, poses, "(views, 7) numbers: x y z, quaternion w x y z")
    if vectors.ndim != 2 or vectors.shape[1] != 7:
        raise InputError(
            f"{name} must have the shape (views, 7), x y z and a quaternion w x y z, got {vectors.shape}"
        )
    with np.errstate(over="ignore"):  # an overflow becomes infinite and is rejected
        lengths = np.linalg.norm(vectors[:, 3:], axis=1)
        invalid_rows = ~((np.abs(vectors[:, :3]) <= LARGEST).all(1) & (lengths > 0) & (lengths < np.inf))
    if invalid_rows.any():
        view = int(np.argmax(invalid_rows))
        raise InputError(
            f"{name}[{view}] must be x y z, at most {LARGEST:g} metres, and a finite quaternion w x y z that "
            f"is not all 0, got {vectors[view].tolist()}"
        )
    matrices = np.zeros((len(vectors), 4, 4))
    matrices[:, :3, :3] = quaternion_to_matrix(vectors[:, 3:])
    matrices[:, :3, 3] = vectors[:, :3]
    matrices[:, 3, 3] = 1
    return matrices


def _constant(pose: np.ndarray):
    """A motion that always has this pose."""
    return lambda time: pose


def _size(camera: Camera | None) -> str:
    return "no camera" if camera is None else f"{camera.width} x {camera.height}"
