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

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.pose_offset import offset_camera
from fidsplat.splats.rotations import nearest_rotation
from fidsplat.train.dataset import Dataset, TrainingView, depths
from fidsplat.train.settings import TrainSettings
from fidsplat.vision.pose import pose_error

_EPSILON = 1e-12
"""epsilon of Adam, small against gradients, which are means over pixels"""
_AT_ORIGIN = Camera.pinhole(4, 4, 4, 4, 2, 2)
INTRINSICS_EVERY = 10
"""iterations between two steps of the intrinsics, by sums of gradients. A step needs the gradients of all
views of a camera, for which a GPU would have to wait in each iteration"""


class _Adam:
    """Adam for vectors of `size` parameters, one (row) per view or camera, of two groups each: rotation and
    translation, focal lengths and centre, or gains and offsets. The second moment is averaged over a group,
    so that the direction of a step does not depend on the choice of axes."""

    def __init__(self, rows: int, size: int, settings: TrainSettings) -> None:
        self._betas = settings.beta1, settings.beta2
        self.moments = np.zeros((2, rows, size))
        self.steps = np.zeros(rows, np.int64)

    def direction(self, row: int, gradient: np.ndarray) -> np.ndarray:
        """The step (size,) of a row, in units of the learning rate."""
        self.steps[row] += 1
        step, corrected = int(self.steps[row]), []
        for moments, beta, sample in zip(self.moments, self._betas, (gradient, gradient**2), strict=True):
            moments[row] += (1 - beta) * (sample - moments[row])
            corrected.append(moments[row] / (1 - beta**step))
        mean, square = (moment.reshape(2, -1) for moment in corrected)
        return (-mean / (np.sqrt(square.mean(axis=1, keepdims=True)) + _EPSILON)).ravel()


class ViewRefinement:
    """Refined cameras and exposures of the training views."""

    def __init__(self, dataset: Dataset, settings: TrainSettings) -> None:
        self._settings = settings
        self._initial = [view.camera for view in dataset.views]
        self.cameras = list(self._initial)
        """current cameras"""
        self.exposures = np.zeros((len(self._initial), 2, 3))
        """logarithms of gains, and offsets, by channel; their means over the views are 0"""
        self._depths = [_median_depth(view, dataset) for view in dataset.views]
        intrinsics = [camera_intrinsics(camera) for camera in self._initial]
        self._rows = {numbers: row for row, numbers in enumerate(dict.fromkeys(intrinsics))}
        """rows of `intrinsics` by the size and intrinsics in the data set"""
        self.intrinsics = np.array([*self._rows])[:, 2:]
        """(cameras, 4): fx, fy, cx, cy"""
        self._intrinsics_sums = np.zeros(self.intrinsics.shape)
        """sums of the gradients since the last step"""
        self._pose_adam, self._exposure_adam = (_Adam(len(self._initial), 6, settings) for _ in range(2))
        self._intrinsics_adam = _Adam(len(self.intrinsics), 4, settings)

    def move(self, view: int, grad_pose: np.ndarray, iteration: int) -> None:
        """Apply a step to the pose of a view. grad_pose: (6,) gradient of the loss by the pose."""
        depth, gradient = self._depths[view], grad_pose.astype(np.float64)
        pivot = np.array([0.0, 0.0, depth])
        gradient[:3] -= np.cross(pivot, gradient[3:])
        gradient[3:] *= depth
        motion = self._settings.pose_rate_at(iteration) * self._pose_adam.direction(view, gradient)
        motion[3:] *= depth
        # the rotation about the camera moves the pivot; move it back
        rotated = offset_camera(_AT_ORIGIN, np.concatenate([motion[:3], np.zeros(3)]))
        motion[3:] += pivot - rotated.world_to_camera[:3, :3] @ pivot
        self.cameras[view] = offset_camera(self.cameras[view], motion)

    def add_intrinsics(self, view: int, by_intrinsics: np.ndarray) -> None:
        """Add a gradient (4,) of the loss of a view by its intrinsics to the sums."""
        self._intrinsics_sums[self._rows[camera_intrinsics(self._initial[view])]] += by_intrinsics

    def change_intrinsics(self, iteration: int) -> None:
        """Apply a step, in units of the focal lengths, to the intrinsics, and clear the sums."""
        rate = self._settings.pose_rate_at(iteration)
        for row, sums in enumerate(self._intrinsics_sums):
            if sums.any():
                focal = np.tile(self.intrinsics[row, :2], 2)
                self.intrinsics[row] += rate * focal * self._intrinsics_adam.direction(row, sums * focal)
        self._intrinsics_sums[:] = 0
        self.cameras = [
            self.with_intrinsics(camera, initial)
            for camera, initial in zip(self.cameras, self._initial, strict=True)
        ]

    def with_intrinsics(self, camera: Camera, initial: Camera) -> Camera:
        """The camera with the refined intrinsics of the training views that had the intrinsics of `initial`;
        unchanged without such views."""
        row = self._rows.get(camera_intrinsics(initial))
        if row is None:
            return camera
        fx, fy, cx, cy = self.intrinsics[row].tolist()
        return replace(camera, fx=fx, fy=fy, cx=cx, cy=cy)

    def expose(self, view: int, by_exposure: np.ndarray, iteration: int) -> None:
        """Apply a step to the exposure of a view. by_exposure: (2, 3) gradient of the loss."""
        direction = self._exposure_adam.direction(view, by_exposure.ravel()).reshape(2, 3)
        self.exposures[view] += self._settings.exposure_rate_at(iteration) * direction

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
        """The state, for a checkpoint."""
        return {
            "poses": np.array([camera.world_to_camera for camera in self.cameras]),
            "pose_moments": self._pose_adam.moments.copy(),
            "pose_steps": self._pose_adam.steps.copy(),
            "intrinsics": self.intrinsics.copy(),
            "intrinsics_sums": self._intrinsics_sums.copy(),
            "intrinsics_moments": self._intrinsics_adam.moments.copy(),
            "intrinsics_steps": self._intrinsics_adam.steps.copy(),
            "exposures": self.exposures.copy(),
            "exposure_moments": self._exposure_adam.moments.copy(),
            "exposure_steps": self._exposure_adam.steps.copy(),
        }

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restore the state of a checkpoint; raise ValueError or LookupError if it does not fit the views."""
        for name, own in self.arrays().items():
            array = arrays[name]
            if array.shape != own.shape or array.dtype != own.dtype or not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite {own.dtype} of the shape {own.shape}")
        self.intrinsics, self._intrinsics_sums, self.exposures = (
            arrays[name].copy() for name in ("intrinsics", "intrinsics_sums", "exposures")
        )
        self.cameras = [
            self.with_intrinsics(
                camera if (pose == camera.world_to_camera).all() else camera.with_pose(pose), camera
            )
            for camera, pose in zip(self._initial, arrays["poses"], strict=True)
        ]
        adams = self._pose_adam, self._intrinsics_adam, self._exposure_adam
        for name, adam in zip(("pose", "intrinsics", "exposure"), adams, strict=True):
            adam.moments, adam.steps = arrays[f"{name}_moments"].copy(), arrays[f"{name}_steps"].copy()


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
    centres, goals = (np.array([camera.position for camera in each]) for each in (cameras, targets))
    spread = (centres - centres.mean(axis=0)) @ rotation.T
    overlap = float((spread * (goals - goals.mean(axis=0))).sum())
    scale = overlap / float((spread**2).sum()) if overlap > 0 else 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation
    matrix[:3, 3] = goals.mean(axis=0) - matrix[:3, :3] @ centres.mean(axis=0)
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
