"""Refinement of the training views by Adam: poses, intrinsics, and exposures (a gain and an offset of each
channel). Views with equal intrinsics share them.

A rotation of a camera is about the point on its optical axis at the median depth of the data set's points,
and a translation is in units of this depth. Then the six numbers move the image by similar amounts and are
nearly independent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fidsplat.backends.view import rotated
from fidsplat.cameras import Camera
from fidsplat.cameras.pose_offset import offset_pose
from fidsplat.cameras.screw import rotation_matrix
from fidsplat.splats.rotations import nearest_rotation, orthogonal_again
from fidsplat.train.dataset import Dataset, TrainingView, depths
from fidsplat.train.settings import TrainSettings
from fidsplat.vision.pose import pose_error

_EPSILON = 1e-12
"""epsilon of Adam, small against gradients, which are means over pixels"""
INTRINSICS_EVERY = 10
"""iterations between two steps of the intrinsics, by sums of gradients of several views"""


class _Adam:
    """Adam for vectors of `size` parameters, one (row) per view or camera, of two groups each: rotation and
    translation, focal lengths and centre, or gains and offsets. The second moment is averaged over a group,
    so that the direction of a step does not depend on the choice of axes."""

    def __init__(self, rows: int, size: int, settings: TrainSettings) -> None:
        self._betas = settings.beta1, settings.beta2
        self.moments = np.zeros((rows, 2, size))
        self.steps = np.zeros(rows, np.int64)

    def next_rate(self, row: int, rate: float) -> float:
        """Count a step of a row; returns the learning rate with the bias corrections of both moments."""
        self.steps[row] += 1
        step, (beta1, beta2) = int(self.steps[row]), self._betas
        return rate * math.sqrt(1 - beta2**step) / (1 - beta1**step)

    def step(self, row: int, gradient: np.ndarray, rate: float) -> np.ndarray:
        """Count a step of a row; returns the change of its parameters (size,)."""
        rate = self.next_rate(row, rate)
        for moment, beta, sample in zip(self.moments[row], self._betas, (gradient, gradient**2), strict=True):
            moment += (1 - beta) * (sample - moment)
        mean, square = self.moments[row].reshape(2, 2, -1)
        return -rate * (mean / (np.sqrt(square.mean(axis=1, keepdims=True)) + _EPSILON)).ravel()


class ViewStep(NamedTuple):
    """A step of the refinement of a view."""

    view: int
    """index of the view of the frame"""
    iteration: int
    next_view: int
    """index of the view of the next frame"""


class ViewRefinement:
    """Refined cameras and exposures of the training views. On devices with training kernels the arrays are
    updated in device memory (kernels/opencl/train/refine_view.cl), and copied here for reports."""

    def __init__(self, dataset: Dataset, settings: TrainSettings) -> None:
        self._settings, self._origin = settings, dataset.origin
        self._initial = [view.camera for view in dataset.views]
        count = len(self._initial)
        self._initial_poses = np.tile(np.eye(4), (count, 1, 1))
        for pose, camera in zip(self._initial_poses, self._initial, strict=True):
            pose[:3, :3] = camera.world_to_camera[:3, :3]
            pose[:3, 3] = rotated(-pose[:3, :3], camera.position - self._origin)
        self.poses = self._initial_poses.copy()
        """(views, 4, 4) world to camera, relative to the data set's origin, as on the device: the values are
        small, also far from the world's origin"""
        self.exposures = np.zeros((count, 2, 3))
        """logarithms of gains, and offsets, by channel; their means over the views are 0"""
        self.depths = [_median_depth(view, dataset) for view in dataset.views]
        """of the points about which the cameras rotate"""
        intrinsics = [camera_intrinsics(camera) for camera in self._initial]
        self._rows = {numbers: row for row, numbers in enumerate(dict.fromkeys(intrinsics))}
        """rows of `intrinsics` by the size and intrinsics in the data set"""
        self.rows = [self._rows[numbers] for numbers in intrinsics]
        """row of `intrinsics` of each view"""
        self.intrinsics = np.array([*self._rows])[:, 2:]
        """(cameras, 4): fx, fy, cx, cy"""
        self._intrinsics_sums = np.zeros(self.intrinsics.shape)
        """sums of the gradients since the last step"""
        self._unapplied: set[int] = set()
        """rows with such gradients"""
        self._pose_adam, self._exposure_adam = (_Adam(count, 6, settings) for _ in range(2))
        self._intrinsics_adam = _Adam(len(self.intrinsics), 4, settings)

    @property
    def cameras(self) -> list[Camera]:
        """Current cameras."""
        return [self.camera(view) for view in range(len(self._initial))]

    def camera(self, view: int) -> Camera:
        """Current camera of a view."""
        camera, pose = self._initial[view], self.poses[view]
        if (pose != self._initial_poses[view]).any():
            rotation = orthogonal_again(pose[:3, :3])  # kernels multiply rotations, possibly in float32
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation.T, self._origin - rotation.T @ pose[:3, 3]
            camera = camera.with_pose(camera_to_world=matrix)
        return self.with_intrinsics(camera, self._initial[view])

    def move(self, view: int, grad_pose: np.ndarray, iteration: int) -> None:
        """Apply a step to the pose of a view. grad_pose: (6,) gradient of the loss by the pose."""
        depth, gradient = self.depths[view], grad_pose.astype(np.float64)
        pivot = np.array([0.0, 0.0, depth])
        gradient[:3] -= np.cross(pivot, gradient[3:])
        gradient[3:] *= depth
        motion = self._pose_adam.step(view, gradient, self._settings.pose_rate_at(iteration))
        motion[3:] *= depth
        # the rotation about the camera moves the pivot; move it back
        motion[3:] += pivot - rotation_matrix(motion[:3]) @ pivot
        self.poses[view] = offset_pose(self.poses[view], motion)

    def pose_rate(self, view: int, iteration: int) -> float:
        """Count a step of a pose on the device; returns its learning rate with bias corrections."""
        settings = self._settings
        return (
            self._pose_adam.next_rate(view, settings.pose_rate_at(iteration))
            if settings.refine_poses
            else 0.0
        )

    def add_intrinsics(self, view: int, by_intrinsics: np.ndarray) -> None:
        """Add a gradient (4,) of the loss of a view by its intrinsics to the sums."""
        self._intrinsics_sums[self.rows[view]] += by_intrinsics

    def due_intrinsics(self, step: ViewStep) -> list[int]:
        """Rows of the intrinsics whose step is due before the step of a view. The view's gradient must be
        added to the sums of its row afterwards."""
        if not self._settings.refine_intrinsics:
            return []
        due: list[int] = []
        # not at multiples of `INTRINSICS_EVERY`, where densification skips the step
        if step.iteration % INTRINSICS_EVERY == 1:
            due, self._unapplied = sorted(self._unapplied), set()
        self._unapplied.add(self.rows[step.view])
        return due

    def change_intrinsics(self, row: int, iteration: int) -> None:
        """Apply a step, in units of the focal lengths, to a row of the intrinsics, and clear its sums."""
        focal, sums = np.tile(self.intrinsics[row, :2], 2), self._intrinsics_sums[row]
        rate = self._settings.pose_rate_at(iteration)
        self.intrinsics[row] += focal * self._intrinsics_adam.step(row, sums * focal, rate)
        sums[:] = 0

    def intrinsics_rate(self, row: int, iteration: int) -> float:
        """Count a step of a row of the intrinsics on the device; returns its learning rate with bias
        corrections."""
        return self._intrinsics_adam.next_rate(row, self._settings.pose_rate_at(iteration))

    def with_intrinsics(self, camera: Camera, initial: Camera) -> Camera:
        """The camera with the refined intrinsics of the training views that had the intrinsics of `initial`;
        unchanged without such views."""
        row = self._rows.get(camera_intrinsics(initial))
        if row is None or camera_intrinsics(camera)[2:] == tuple(self.intrinsics[row]):
            return camera
        fx, fy, cx, cy = self.intrinsics[row].tolist()
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    def expose(self, view: int, by_exposure: np.ndarray, iteration: int) -> None:
        """Apply a step to the exposure of a view. by_exposure: (2, 3) gradient of the loss."""
        rate = self._settings.exposure_rate_at(iteration)
        self.exposures[view] += self._exposure_adam.step(view, by_exposure.ravel(), rate).reshape(2, 3)

    def exposure_rate(self, view: int, iteration: int) -> float:
        """Count a step of an exposure on the device; returns its learning rate with bias corrections."""
        if not self._settings.fit_exposures:
            return 0.0
        return self._exposure_adam.next_rate(view, self._settings.exposure_rate_at(iteration))

    def centre_exposures(self) -> None:
        """Set the means of the exposures over the views to 0; the splats' colours then compensate."""
        self.exposures -= self.exposures.mean(axis=0)

    def to_dataset(self) -> np.ndarray:
        """(4, 4) similarity that aligns the refined cameras with those of the data set. Images determine a
        scene only up to a similarity, along which refinement drifts."""
        return alignment(self.cameras, self._initial)

    def aligned(self) -> list[Camera]:
        """The refined cameras, aligned with the cameras of the data set."""
        matrix = self.to_dataset()
        return [moved(camera, matrix) for camera in self.cameras]

    def pose_changes(self) -> np.ndarray:
        """(views, 2): metres and degrees between the cameras of the data set and the aligned ones."""
        pairs = zip(self._initial, self.aligned(), strict=True)
        differences = [pose_error(a.camera_to_world, b.camera_to_world) for a, b in pairs]
        return np.array(differences) * (1, 180 / math.pi)

    def arrays(self) -> dict[str, np.ndarray]:
        """A copy of the state, for a checkpoint or a device."""
        arrays = {
            **{"poses": self.poses, "intrinsics": self.intrinsics, "exposures": self.exposures},
            "intrinsics_sums": self._intrinsics_sums,
        }
        for name, adam in self._adams():
            arrays |= {f"{name}_moments": adam.moments, f"{name}_steps": adam.steps}
        return {name: array.copy() for name, array in arrays.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the state of a checkpoint; raise ValueError or LookupError if it does not fit the views."""
        for name, own in self.arrays().items():
            array = arrays[name]
            if array.shape != own.shape or array.dtype != own.dtype or not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite {own.dtype} of the shape {own.shape}")
        self.set_arrays(arrays)
        self._unapplied = set(np.flatnonzero(self._intrinsics_sums.any(axis=1)).tolist())
        for name, adam in self._adams():
            adam.steps = arrays[f"{name}_steps"].copy()

    def set_arrays(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Set the state except numbers of steps."""
        self.poses, self.intrinsics, self.exposures, self._intrinsics_sums = (
            arrays[name].copy() for name in ("poses", "intrinsics", "exposures", "intrinsics_sums")
        )
        for name, adam in self._adams():
            adam.moments = arrays[f"{name}_moments"].copy()

    def _adams(self) -> list[tuple[str, _Adam]]:
        adams = self._pose_adam, self._intrinsics_adam, self._exposure_adam
        return list(zip(("pose", "intrinsics", "exposure"), adams, strict=True))


def camera_intrinsics(camera: Camera) -> tuple[float, ...]:
    """Size and intrinsics of a camera."""
    return camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy


def alignment(cameras: Sequence[Camera], targets: Sequence[Camera]) -> np.ndarray:
    """(4, 4) similarity that aligns cameras with target cameras: the mean rotation, and the scale and
    translation of least squares between their centres."""
    pairs = [
        (one.world_to_camera[:3, :3], other.world_to_camera[:3, :3])
        for one, other in zip(cameras, targets, strict=True)
    ]
    rotation = nearest_rotation(np.sum([other.T @ one for one, other in pairs], axis=0))
    centers, goals = (np.array([camera.position for camera in each]) for each in (cameras, targets))
    spread = (centers - centers.mean(axis=0)) @ rotation.T
    overlap = float((spread * (goals - goals.mean(axis=0))).sum())
    scale = overlap / float((spread**2).sum()) if overlap > 0 else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = goals.mean(axis=0) - matrix[:3, :3] @ centers.mean(axis=0)
    return matrix


def moved(camera: Camera, matrix: np.ndarray) -> Camera:
    """The camera after a similarity transform (4, 4) of the world, without the scale."""
    pose = np.eye(4)
    pose[:3, :3] = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3])) @ camera.world_to_camera[:3, :3].T
    pose[:3, 3] = matrix[:3, :3] @ camera.position + matrix[:3, 3]
    return camera.with_pose(camera_to_world=pose)


def with_exposure_of(rendered: np.ndarray, view: TrainingView) -> np.ndarray:
    """Fit the gain and offset of each channel of a rendered image (h, w, 3) to the image of a view."""
    target = view.image.astype(np.float64) / 255
    inside = np.ones(target.shape[:2], bool) if view.mask is None else view.mask
    corrected = np.empty_like(rendered)
    for channel in range(3):
        x, y = rendered[:, :, channel], target[:, :, channel][inside]
        terms = np.stack([x[inside].astype(np.float64), np.ones(len(y))], axis=1)
        (gain, offset), *_ = np.linalg.lstsq(terms, y, rcond=None)
        corrected[:, :, channel] = gain * x + offset
    return corrected


def _median_depth(view: TrainingView, dataset: Dataset) -> float:
    """Median depth of the points in front of a camera; the scene extent without any."""
    all_depths = depths(view.camera, dataset.points)
    all_depths = all_depths[all_depths > view.camera.near]
    return float(np.median(all_depths)) if len(all_depths) else dataset.extent
