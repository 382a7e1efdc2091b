"""Shutters and motion: poses as functions of time."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from fidsplat.cameras.pinhole import Camera
from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.util.arguments import as_float, instance, invalid, number, python_scalars, whole_number
from fidsplat.util.errors import InputError

MAX_SUB_POSES = 1024

Pose: TypeAlias = Callable[[float], np.ndarray]
"""(4, 4) rigid matrix at a time in seconds"""


@dataclass(frozen=True)
class Shutter:
    """Exposure times of the rows of an image; by default an instant global shutter. The exposure of the
    middle row is centred at `time`; row i of h is exposed `readout` * ((i + 1/2) / h - 1/2) seconds later."""

    time: float = 0.0
    """seconds, in the time of the poses"""
    exposure_time: float = 0.0
    """seconds that each row is exposed; the image is the mean of `sub_poses` sub-frames"""
    sub_poses: int = 8
    """number n of poses per exposure, each in the middle of an n-th of the exposure time"""
    readout: float = 0.0
    """seconds between the exposures of the first and the last row (rolling shutter)"""
    rows_per_band: int = 8
    """rows of a band, which share the poses of its middle row. The error for an object that moves v pixels
    during the readout of h rows is at most v (rows_per_band - 1) / (2 h) pixels; 1 is exact and slow"""

    def __post_init__(self) -> None:
        python_scalars(self)
        for name in ("time", "exposure_time", "readout"):
            value = getattr(self, name)
            if not math.isfinite(as_float(value)):
                raise InputError(f"shutter {name} must be a finite number of seconds, got {value!r}")
            if name != "time" and value < 0:
                raise InputError(f"shutter {name} must be 0 or more seconds, got {value!r}")
        for name, maximum in (("sub_poses", MAX_SUB_POSES), ("rows_per_band", math.inf)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= maximum:
                limit = f"1 to {MAX_SUB_POSES}" if name == "sub_poses" else "1 or more"
                raise InputError(f"shutter {name} must be a whole number, {limit}, got {value!r}")

    def bands(self, height: int) -> list[tuple[int, int, float]]:
        """(first row, end row, middle of the exposure time) of each band of an image of `height` rows."""
        height = whole_number("the height of an image", height, 1, 2**24)
        rows = self.rows_per_band if self.readout > 0 else height
        cuts = [*range(0, height, rows), height]
        return [
            (top, end, self.time + self.readout * ((top + end) / 2 / height - 0.5))
            for top, end in itertools.pairwise(cuts)
        ]

    def times(self, middle: float) -> list[float]:
        """Times of the sub-poses of an exposure with its middle at a time."""
        middle = number("the middle of an exposure", middle)
        n = self.sub_poses if self.exposure_time > 0 else 1
        return [middle + self.exposure_time * ((k + 0.5) / n - 0.5) for k in range(n)]


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the camera and of groups of splats: poses as functions of the time in seconds, each a
    `Trajectory` or any callable."""

    camera: Pose | None = None
    """world_to_camera; None: a static camera"""
    groups: Mapping[int, Pose] = field(default_factory=dict)
    """label of splats -> their rigid motion in the world, applied to the poses of their cloud"""

    def __post_init__(self) -> None:
        if self.camera is not None and not callable(self.camera):
            raise InputError(
                f"motion of the camera must be a Trajectory or a function of time, got {self.camera!r}"
            )
        if not isinstance(self.groups, Mapping) or not all(map(callable, self.groups.values())):
            raise invalid("motion of groups", "{label: Trajectory or function of time}", self.groups)
        for label in self.groups:
            if isinstance(label, bool) or not isinstance(label, (int, np.integer)):
                raise InputError(
                    f"label of a moving group must be a whole number, got {label!r}; SplatCloud.with_labels "
                    "sets labels"
                )
        object.__setattr__(self, "groups", MappingProxyType(dict(self.groups)))

    def __reduce__(self):
        return Motion, (self.camera, dict(self.groups))  # a mapping proxy cannot be pickled

    @cached_property
    def is_still(self) -> bool:
        """Whether neither the camera nor a group moves."""
        return self.camera is None and not self.groups

    def camera_at(self, time: float) -> np.ndarray | None:
        """world_to_camera (4, 4) at a time; None for a static camera."""
        time = number("the time of a motion", time)
        return None if self.camera is None else _rigid_pose(self.camera(time), "the camera", time)

    def sampled(self, times: Iterable[float]) -> Motion:
        """A copy with the poses at these times only, which can be pickled even if poses are functions."""
        try:
            moments = [number("a time", time, "a finite number of seconds") for time in times]
        except TypeError:
            raise invalid("times", "numbers of seconds", times) from None
        groups = {label: _PoseTable({t: pose(t) for t in moments}) for label, pose in self.groups.items()}
        camera = self.camera and _PoseTable({t: self.camera(t) for t in moments})
        return Motion(camera, groups)

    def moved(self, camera: Camera, time: float) -> Camera:
        """The camera at its pose at a time."""
        instance("the camera of a motion", camera, Camera)
        pose = self.camera_at(time)
        return camera if pose is None else camera.with_pose(pose)

    def groups_at(self, time: float) -> list[tuple[int, np.ndarray]]:
        """Label and motion (4, 4) of each group at a time."""
        time = number("the time of a motion", time)
        return [
            (label, _rigid_pose(pose(time), f"the splats of label {label}", time))
            for label, pose in sorted(self.groups.items())
        ]


@dataclass(frozen=True, eq=False)
class _PoseTable:
    """Poses at sampled times, as a function of the time."""

    poses: dict[float, np.ndarray]

    def __call__(self, time: float) -> np.ndarray:
        if time not in self.poses:
            sampled = ", ".join(f"{t:g}" for t in self.poses)
            raise InputError(f"time must be a sampled time of this motion ({sampled} s), got {time:g} s")
        return self.poses[time]


def _rigid_pose(matrix, what: str, time: float) -> np.ndarray:
    """Validated rigid pose (4, 4) float64."""
    matrix = pose_matrix(matrix, f"the pose of {what} at {time:g} s")
    check_similarity(matrix, f"the pose of {what} at {time:g} s", rigid=True)
    return np.asarray(matrix, np.float64)
