"""Data of a scene: splats, markers with poses, and how they are captured."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fidsplat.cameras import Camera, Motion, Shutter
from fidsplat.capture.capture import Capture, output_names
from fidsplat.capture.environment import Background, Fog, background_of
from fidsplat.capture.quality import Quality
from fidsplat.capture.sensor import Sensor
from fidsplat.scenes.lights import Light, Lighting
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.store.chunked_splats import ChunkedSplats
from fidsplat.store.store import Store
from fidsplat.util.arguments import PickledByFields, invalid
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.cameras.motion import Pose
    from fidsplat.markers import Marker


@dataclass(frozen=True, eq=False)
class PlacedMarker(PickledByFields):
    """A marker with a pose in the world.

    Raises InputError if the pose is not rigid, the motion is not a function, or the bundle is not a name.
    """

    marker: Marker
    pose: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) float64, world_from_marker, rigid, read-only; or given as (position, quaternion w, x, y, z)"""
    label: int = 1
    """label of its splats; a Scene numbers its markers 1, 2, ..."""
    motion: Pose | None = None
    """pose at a time [s]; None: constant"""
    bundle: str | None = None
    """name of the rigid object of several markers, whose poses are detected together"""
    light: Lighting | str | None = None
    """light that determines the rendered colours: "scene", "lights" or a Lighting; None: the marker's own
    colours. The light of a moving marker is that at its initial pose."""

    def __post_init__(self) -> None:
        matrix = pose_matrix(self.pose, "a marker's pose")
        check_similarity(matrix, "a marker's pose", rigid=True)
        if self.motion is not None and not callable(self.motion):
            raise InputError(
                "a marker's motion must be an fs.Trajectory or a function of time, got a "
                f"{type(self.motion).__name__}"
            )
        if self.bundle is not None and not (isinstance(self.bundle, str) and self.bundle):
            raise InputError(f"a marker's bundle must be a name or None, got {self.bundle!r}")
        if not isinstance(getattr(self.marker, "cloud", None), SplatCloud):
            raise InputError(
                f"marker must be an fs.Marker, got {self.marker!r}; e.g. fs.marker('apriltag:36h11:5')"
            )
        object.__setattr__(self, "light", Lighting.of(self.light))
        pose = np.array(matrix, dtype=np.float64)
        pose.flags.writeable = False
        object.__setattr__(self, "pose", pose)

    @cached_property
    def corners(self) -> np.ndarray:
        """Corners (4, 3) float64 of the code's outer edge in the world: top left, top right, bottom right,
        bottom left; read-only."""
        corners = np.asarray(self.marker.corners, np.float64) @ self.pose[:3, :3].T + self.pose[:3, 3]
        corners.flags.writeable = False
        return corners

    def cloud(self) -> SplatCloud:
        """The marker's splats in the world, all with its label."""
        return self.marker.cloud.transformed(self.pose).with_labels(self.label)


@dataclass(frozen=True, eq=False)
class SceneParts(PickledByFields):
    """Base of `Scene`: its fields, without methods. Raises InputError for a field of the wrong type."""

    clouds: tuple[SplatCloud, ...] = ()
    """splats in the world, with their own labels"""
    camera: Camera | None = None
    markers: tuple[PlacedMarker, ...] = ()
    """markers; the label of marker i is set to i + 1"""
    background: Background = (0.0, 0.0, 0.0)
    """RGB in display space, a Gradient or a Panorama"""
    outputs: tuple[str, ...] = ("rgb",)
    """names of the output images"""
    quality: Quality | str | None = None
    """a Quality, text (`Quality.of`), or None for the default"""
    device: str | None = None
    """name of a device, or None for the default"""
    shutter: Shutter | None = None
    """time, exposure and readout; None: an instantaneous shutter at time 0"""
    camera_motion: Pose | None = None
    """world_to_camera at a time [s]; None: constant"""
    sensor: Sensor | None = None
    """sensor model applied to rgb"""
    fog: Fog | None = None
    """fog between camera and splats"""
    stores: tuple[Store, ...] = ()
    """splats on disk, in the world, with their own labels; visible chunks are read"""
    cloud_motions: Mapping[int, Pose] = field(default_factory=dict)
    """rigid world motion at a time [s] of moving clouds, by index; these clouds have unique labels above
    the labels of markers"""
    lights: tuple[Light, ...] = ()
    """lights that illuminate the markers with `light`"""

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "clouds", _all_of(self.clouds, SplatCloud, "clouds"))
        put(self, "stores", _all_of(self.stores, Store, "stores"))
        put(self, "lights", _all_of(self.lights, Light, "lights"))
        Motion(self.camera_motion)  # raises for an invalid motion
        moving = self.cloud_motions
        if not isinstance(moving, Mapping) or not all(map(callable, moving.values())):
            raise InputError(
                "cloud_motions must be {number of the cloud: fs.Trajectory or function of time}, got "
                f"{str(moving)[:80]}"
            )
        for number in moving:
            if isinstance(number, bool) or number not in range(len(self.clouds)):
                raise InputError(
                    f"cloud_motions must have numbers of clouds below {len(self.clouds)}, got {number!r}"
                )
        put(self, "cloud_motions", dict(moving))
        placed = _all_of(self.markers, PlacedMarker, "markers")
        put(self, "markers", tuple(replace(marker, label=i + 1) for i, marker in enumerate(placed)))
        if not isinstance(self.shutter, Shutter | None):
            raise InputError(f"shutter must be a Shutter, got {self.shutter!r}")
        if not isinstance(self.camera, Camera | None):
            raise InputError(f"camera must be a Camera, got {self.camera!r}")
        put(self, "background", background_of(self.background))
        for name, kind in (("sensor", Sensor), ("fog", Fog)):
            if not isinstance(getattr(self, name), kind | None):
                raise InputError(f"{name} must be a {kind.__name__}, got {getattr(self, name)!r}")
        put(self, "outputs", output_names(self.outputs))

    @cached_property
    def motion(self) -> Motion:
        """Motion of the camera, and of markers and clouds by label."""
        groups = {
            marker.label: _MarkerMotion(marker.pose, marker.motion)
            for marker in self.markers
            if marker.motion is not None
        }
        groups |= {self._labels[number]: motion for number, motion in self.cloud_motions.items()}
        return Motion(self.camera_motion, groups)

    @cached_property
    def capture(self) -> Capture:
        """Capture of the scene. Raises InputError for an unknown quality."""
        return Capture(
            self.camera, self.outputs, Quality.of(self.quality), self.background, self.motion,
            self.shutter or Shutter(), self.sensor or Sensor(), self.fog,
        )  # fmt: skip

    def cloud(self) -> SplatCloud:
        """All splats in one cloud: stores (read completely), clouds, then markers."""
        return self.splats.cloud() if isinstance(self.splats, ChunkedSplats) else self.splats

    @cached_property
    def splats(self) -> SplatCloud | ChunkedSplats:
        """All splats: one cloud, or stores and a cloud in memory that are read in chunks."""
        return ChunkedSplats(self.stores, self._in_memory) if self.stores else self._in_memory

    @property
    def content(self) -> SplatCloud | tuple:
        """The splats for digests: the cloud, or digests of the stores and the cloud in memory."""
        return self.splats.content if isinstance(self.splats, ChunkedSplats) else self.splats

    @cached_property
    def _in_memory(self) -> SplatCloud:
        labels = self._labels
        clouds = [
            cloud.with_labels(labels[i]) if i in labels else cloud for i, cloud in enumerate(self.clouds)
        ]
        return SplatCloud.concatenate([*clouds, *(marker.cloud() for marker in self.markers)])

    @cached_property
    def _labels(self) -> dict[int, int]:
        """Labels of moving clouds by the index of the cloud."""
        if not self.cloud_motions:
            return {}
        still = [cloud.labels for i, cloud in enumerate(self.clouds) if i not in self.cloud_motions]
        used = {int(label) for labels in still for label in np.unique(labels)}
        used |= {label for store in self.stores for label in store.labels()}
        free = (label for label in itertools.count(len(self.markers) + 1) if label not in used)
        return dict(zip(sorted(self.cloud_motions), free, strict=False))


@dataclass(frozen=True, eq=False)
class _MarkerMotion:
    """World motion of a marker from its initial pose, as plain data for `digest_of`."""

    start: np.ndarray
    motion: Pose

    def __call__(self, time: float) -> np.ndarray:
        pose = self.motion(time)
        check_similarity(pose, f"a marker's pose at {time:g} s", rigid=True)
        return np.asarray(pose, np.float64) @ np.linalg.inv(self.start)


T = TypeVar("T")
_INSTEAD = {
    "Marker": "write markers=[PlacedMarker(marker, pose)], from fidsplat.scenes, or clouds=[marker.cloud]",
    "PlacedMarker": "write markers=[...]",
    "SplatCloud": "write clouds=[...]",
    "Store": "write stores=[...]",
    "lights": "write e.g. lights=[fs.Sun(direction=(0, 0, 1))], fs.PointLight or fs.SpotLight",
    "str": "Scene.load reads a scene file, load_splats a splat file, Store a store; marker makes a marker",
}
"""remedies for values of the wrong class, by its name or that of the argument"""


def _all_of(values: Iterable, kind: type[T], name: str) -> tuple[T, ...]:
    """The items of a list of one class. Raises InputError."""
    if isinstance(values, kind):
        raise invalid(name, f"a list of {kind.__name__}", values, "put it into a list")
    try:
        items: tuple[Any, ...] = (values,) if isinstance(values, str) else tuple(values)
    except TypeError:
        items = (values,)
    for value in items:
        if not isinstance(value, kind):
            found = "str" if isinstance(value, PathLike) else type(value).__name__
            hint = _INSTEAD.get(found, _INSTEAD.get(name, ""))
            raise invalid(name, f"a list of {kind.__name__}", value, hint)
    return items
