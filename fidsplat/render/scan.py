"""LiDAR scans of a scene: ranges, intensities, labels and times of beams."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.cameras import Camera, Motion, RayTable, Shutter
from fidsplat.cameras.foreign import LINK_FROM_OPTICAL
from fidsplat.capture.capture import Capture
from fidsplat.capture.lidar import Lidar, Spinning
from fidsplat.capture.sensor import LUMINANCE, Sensor
from fidsplat.capture.views import pose_matrices
from fidsplat.formats.points import save_points
from fidsplat.splats.rotations import check_similarity, pose_matrix
from fidsplat.util.arguments import instance, invalid, number, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.response import linear_light

if TYPE_CHECKING:
    from fidsplat.render.renderer import Renderer
    from fidsplat.render.resident import ResidentCloud
    from fidsplat.scenes import Scene
    from fidsplat.splats.cloud import SplatCloud

_REFLECTIVITY = 0.1
"""reflectivity of the surface that is detected at `Lidar.detection_range`"""
_ODDS_AT_RANGE = 9
"""odds of detection at `Lidar.detection_range`: 9 to 1, 90 %. Odds are proportional to signal^4: a third of
the signal is detected with a probability of 10 %"""
_ALPHA_CUTOFF = 1e-3
"""lower limit of the alpha cut-off of a scan: fainter fragments hardly change the distance at which the
accumulated opacity reaches `Lidar.opacity`"""


@dataclass(frozen=True, eq=False)
class Scan:
    """A LiDAR scan: arrays of beams in the order of firing, with r = len(lidar.returns) returns per beam."""

    lidar: Lidar
    start: float
    """seconds: start of the scan"""
    range: np.ndarray
    """(r, beams) float32 metres; 0 where there is no return"""
    intensity: np.ndarray
    """(r, beams) float32: reflectivity times cosine of incidence, times the fraction of the beam's area that
    is on the surface; 0 where there is no return"""
    label: np.ndarray | None
    """(r, beams) int32, -1 where there is no return; None without `label=True`"""
    poses: np.ndarray
    """(k, 4, 4) world_from_lidar, one for each rolling-shutter band of the scan"""

    @cached_property
    def time(self) -> np.ndarray:
        """(beams,) float64 seconds after the start."""
        return self.lidar.pattern.fractions() * self.lidar.duration

    @cached_property
    def ring(self) -> np.ndarray:
        """(beams,) index of the laser."""
        return self.lidar.pattern.ring_of()

    @property
    def directions(self) -> np.ndarray:
        """(beams, 3) float64 unit directions in the lidar's frame."""
        return self.lidar.directions(self.start)

    @cached_property
    def pose_index(self) -> np.ndarray:
        """(beams,) index of the pose of each beam."""
        moving = len(self.poses) > 1
        band_pixels = self.lidar.camera(self.start, moving).width * self.lidar.rows_per_band(moving)
        return self.lidar.pixels(self.start, moving)[:, 0] // band_pixels

    @cached_property
    def points(self) -> np.ndarray:
        """(r, beams, 3) float64 metres in the lidar's frame at the time of the beam; NaN without a return."""
        return np.where(self.range > 0, self.range.astype(np.float64), np.nan)[..., None] * self.directions

    @cached_property
    def world_points(self) -> np.ndarray:
        """(r, beams, 3) float64 metres in the world; NaN without a return."""
        poses = self.poses[self.pose_index]
        return np.einsum("bij,rbj->rbi", poses[:, :3, :3], self.points) + poses[:, :3, 3]

    def image(self, name: str = "range") -> np.ndarray:
        """range, intensity or label as (returns, rings, columns), left (azimuth pi) to right, for a spinning
        lidar."""
        pattern = self.lidar.pattern
        if not isinstance(pattern, Spinning):
            raise InputError(
                "the lidar of Scan.image must have the pattern Spinning, got a Rosette; use Scan.points"
            )
        if name not in ("range", "intensity", "label") or getattr(self, name) is None:
            raise InputError(
                f"name must be 'range', 'intensity' or (for scans with label=True) 'label', got {name!r}"
            )
        values = getattr(self, name)
        return values.reshape(len(values), pattern.columns, pattern.rings).swapaxes(1, 2)

    def cloud(self, frame: str = "lidar") -> np.ndarray:
        """Points with a return, as a structured array: x, y, z, intensity float32, ring uint16, time float32
        (seconds after the start), echo uint8 (index of the return), and label int32 if requested.

        frame: "lidar" or "world"; a world far from the origin is rounded to float32.
        """
        check_frame(frame)
        echo, beam = np.nonzero(self.range.T > 0)[::-1]
        points = (self.points if frame == "lidar" else self.world_points)[echo, beam]
        columns: dict[str, np.ndarray] = {
            name: points[:, k].astype(np.float32) for k, name in enumerate("xyz")
        }
        columns["intensity"] = self.intensity[echo, beam]
        columns["ring"] = self.ring[beam].astype(np.uint16)
        columns["time"] = self.time[beam].astype(np.float32)
        columns["echo"] = echo.astype(np.uint8)
        if self.label is not None:
            columns["label"] = self.label[echo, beam]
        result = np.empty(len(beam), [(name, values.dtype) for name, values in columns.items()])
        for name, values in columns.items():
            result[name] = values
        return result

    def save(self, path: str | os.PathLike[str], frame: str = "lidar") -> None:
        """Write `cloud` as .pcd, .ply or .npy. Raises InputError for another ending."""
        save_points(self.cloud(frame), path)


def check_frame(frame: str) -> None:
    """Raise InputError for a frame other than lidar and world."""
    if frame not in ("lidar", "world"):
        raise invalid("frame", "lidar or world", frame)


def scan(
    scene: Scene | SplatCloud | ResidentCloud,
    lidar: Lidar | str,
    pose: Any = None,
    *,
    renderer: Renderer | None = None,
    motion: Motion | None = None,
    start: float | None = None,
    label: bool = False,
    index: int = 0,
) -> Scan:
    """Scan a scene.

    Args:
        scene: splats and markers, or a cloud uploaded by `renderer`.
        lidar: a Lidar, or the name of a preset.
        pose: world_from_lidar, (4, 4) or (position, quaternion w, x, y, z), of a sensor with x forward, y
            left and z up; None: at the scene's camera at `start`.
        renderer: None: one for the scene's device.
        motion: `camera` is a function of time that returns lidar_from_world, instead of `pose`; `groups`
            moves splats. None: one pose for all beams, and groups follow the scene's motion.
        start: seconds, start of the scan; None: the time of the scene's shutter.
        label: whether the scan has labels of splats.
        index: number of the scan, which selects its random noise.

    Raises:
        InputError: no pose, or a pose that is not rigid; as `Renderer.render`.
    """
    renderer, resident = _renderer_and_cloud(scene, renderer)
    request = ScanRequest.of(lidar, scene, label, motion, start)
    capture = request.capture(pose)
    assert capture.camera is not None
    frame = renderer.render(resident, capture)
    bands = capture.shutter.bands(capture.camera.height)
    poses = [capture.motion.moved(capture.camera, middle).camera_to_world for _, _, middle in bands]
    return request.decoded(dict(frame), np.stack(poses), whole_number("index", index, 0, 2**32 - 1))


def scan_batch(
    scene: Scene | SplatCloud | ResidentCloud,
    lidar: Lidar | str,
    poses: Any,
    *,
    renderer: Renderer | None = None,
    start: float | None = None,
    label: bool = False,
) -> list[Scan]:
    """Scan a scene from many poses in one submission; scan i has the noise of `scan(..., index=i)`.

    Args:
        poses: (v, 7) world from lidar: x y z and a quaternion w x y z.
        scene, lidar, renderer, start, label: as in `scan`. Nothing moves during a scan: moving groups of the
            scene have their poses at the middle of the scan.

    Raises:
        InputError: as `scan`.
    """
    renderer, resident = _renderer_and_cloud(scene, renderer)
    matrices = pose_matrices("poses", poses)
    request = replace(ScanRequest.of(lidar, scene, label, None, start), moving=False)
    batch = renderer.render_batch(resident, request.capture(np.eye(4)), poses=poses)
    images = dict(batch)

    def decoded(view: int) -> Scan:
        view_images = {name: image[view] for name, image in images.items()}
        return request.decoded(view_images, matrices[view : view + 1], view)

    with ThreadPoolExecutor() as pool:  # NumPy computes without Python's global lock
        return list(pool.map(decoded, range(len(matrices))))


def _renderer_and_cloud(scene: Any, renderer: Renderer | None) -> tuple[Renderer, Any]:
    from fidsplat.render.renderer import Renderer
    from fidsplat.render.resident import ResidentCloud

    resident = isinstance(scene, ResidentCloud)
    if renderer is None and resident:
        raise InputError("renderer must be the renderer that uploaded the cloud, got None; pass renderer=")
    if renderer is None:
        renderer = Renderer(getattr(scene, "device", None))
    instance("renderer", renderer, Renderer, remedy="fs.Renderer('opencl') opens a device")
    return renderer, scene if resident else renderer.upload(scene)


@dataclass(frozen=True)
class ScanRequest:
    """Arguments of a scan, except the pose."""

    lidar: Lidar
    base: Capture
    """camera and settings of the scene"""
    motion: Motion
    start: float
    label: bool
    moving: bool
    """whether the lidar or a group of splats moves during the scan"""

    @classmethod
    def of(
        cls, lidar: Lidar | str, scene: Any, label: bool, motion: Motion | None, start: Any
    ) -> ScanRequest:
        lidar = Lidar.preset(lidar) if isinstance(lidar, str) else instance("lidar", lidar, Lidar)
        base = getattr(scene, "capture", None) or Capture()
        if motion is None:
            motion = Motion(None, base.motion.groups)
        instance("motion", motion, Motion)
        start = base.shutter.time if start is None else number("start", start, "a finite number of seconds")
        return cls(lidar, base, motion, start, label, not motion.is_still)

    def capture(self, pose: Any) -> Capture:
        lidar = self.lidar
        camera = lidar.camera(self.start, self.moving)
        if self.motion.camera is None:
            scene_camera = self.base.camera and self.base.motion.moved(self.base.camera, self.start)
            camera = camera.with_pose(camera_to_world=_pose_of(pose, scene_camera))
        elif pose is not None:
            raise InputError("a scan must have either pose or motion.camera, got both; leave one out")
        quality = replace(
            self.base.quality,
            samples=1,
            lowpass="none",
            alpha_cutoff=max(self.base.quality.alpha_cutoff, _ALPHA_CUTOFF),
            first_hit=lidar.opacity,
            # below the transmittance at the surface, so that rounding does not stop blending before it
            transmittance_stop=(1 - lidar.opacity) * (1 - 1e-6),
        )
        return replace(
            self.base,
            camera=camera,
            outputs=(
                "rgb",
                "alpha",
                "normal",
                "distance_first",
                *["label"] * (self.label or bool(lidar.reflectivity)),
            ),
            quality=quality,
            background=(0.0, 0.0, 0.0),
            motion=self.motion,
            shutter=Shutter(
                time=self.start + lidar.duration / 2,
                readout=lidar.duration if self.moving else 0.0,
                rows_per_band=lidar.rows_per_band(self.moving),
            ),
            sensor=Sensor(),
            fog=None,
            external_depth=None,
        )

    def decoded(self, images: Mapping[str, np.ndarray], poses: np.ndarray, number_of_scan: int) -> Scan:
        """Convert rendered images to a scan. poses: (k, 4, 4) world_from_lidar of each band."""
        lidar, pixels = self.lidar, self.lidar.pixels(self.start, self.moving)

        def by_ray(image: np.ndarray) -> np.ndarray:
            pixel_values = image.reshape(-1, *image.shape[2:])
            # the rays of a spinning lidar are all pixels, in order
            return pixel_values if isinstance(lidar.pattern, Spinning) else pixel_values[pixels.reshape(-1)]

        images = {name: by_ray(image) for name, image in images.items()}
        lens = lidar.camera(self.start, self.moving).lens
        assert isinstance(lens, RayTable)
        intensity = _intensity(images, by_ray(lens.directions), lidar.reflectivity)
        rays = {"range": images["distance_first"], "intensity": intensity}
        if self.label:
            rays["label"] = images["label"]
        returns = _returns({name: values.reshape(pixels.shape) for name, values in rays.items()}, lidar)
        _simulate_detection(returns, lidar, np.random.default_rng((lidar.seed, number_of_scan)))
        label = returns["label"].astype(np.int32) if self.label else None
        ranges, intensity = (returns[name].astype(np.float32, copy=False) for name in ("range", "intensity"))
        return Scan(lidar, self.start, ranges, intensity, label, poses)


def _intensity(
    images: Mapping[str, np.ndarray], directions: np.ndarray, reflectivity: Mapping[int, float]
) -> np.ndarray:
    """Reflectivity times cosine of incidence, (rays,) float32, from rendered outputs (rays, ...)."""
    color = images["rgb"] / np.maximum(images["alpha"], 1e-6)[:, None]
    light = linear_light(np.minimum(color, 1), "srgb", np.float32) @ LUMINANCE.astype(np.float32)
    for label, value in reflectivity.items():
        light[images["label"] == label] = value
    cosine = (directions.astype(np.float32) * images["normal"]) @ np.ones(3, np.float32)
    return light * np.abs(cosine) * (images["distance_first"] > 0)


def _pose_of(pose: Any, camera: Camera | None) -> np.ndarray:
    """Pose world_from_lidar (4, 4); by default at the camera."""
    if pose is None:
        if camera is None:
            raise InputError("pose must be given for a scene without a camera, got None; pass pose=")
        return camera.camera_to_world @ np.linalg.inv(LINK_FROM_OPTICAL)
    matrix = pose_matrix(pose, "the pose of a lidar")
    check_similarity(matrix, "the pose of a lidar", rigid=True)
    return matrix


def _returns(rays: dict[str, np.ndarray], lidar: Lidar) -> dict[str, np.ndarray]:
    """Group rays (beams, n) into the LiDAR's returns (r, beams). Rays within `separation` of each other form
    one return: its range is their mean weighted by signal, its intensity their sum / n, its label that of the
    nearest ray."""
    count = lidar.rays
    if count == 1:
        return {name: values.T.copy() for name, values in rays.items()}
    order = np.argsort(np.where(rays["range"] > 0, rays["range"], np.inf), axis=1, kind="stable")
    by_range = {name: np.take_along_axis(values, order, 1) for name, values in rays.items()}
    ranges, hits = by_range["range"], by_range["range"] > 0
    starts = np.diff(np.where(hits, ranges, 0.0), axis=1, prepend=-np.inf) > lidar.separation
    group = np.clip(np.cumsum(starts & hits, axis=1) - 1, 0, count - 1)
    # 1e-9: a group of black surfaces has a range too
    signal = np.where(hits, (by_range["intensity"] + 1e-9) / np.where(hits, ranges, 1.0) ** 2, 0.0)
    beams = np.arange(len(ranges))[:, None]

    def sum_by_group(values: np.ndarray) -> np.ndarray:
        total = np.zeros(ranges.shape)
        np.add.at(total, (beams, group), np.where(hits, values, 0.0))
        return total

    power = sum_by_group(signal)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(power > 0, sum_by_group(signal * ranges) / power, 0.0)
    light = sum_by_group(by_range["intensity"]) / count
    groups = (power > 0).sum(1)
    chosen = []
    for kind in lidar.returns:
        index = {"first": 0 * groups, "last": groups - 1, "strongest": power.argmax(1)}[kind]
        repeated = np.logical_or.reduce([index == other for other in chosen]) if chosen else groups < 0
        chosen.append(np.where((groups > 0) & ~repeated, index, -1))
    indices = np.stack(chosen)
    exists, at = indices >= 0, np.clip(indices, 0, count - 1)
    beam = np.arange(len(ranges))
    returns = {
        name: np.where(exists, values[beam, at], 0.0)
        for name, values in (("range", mean), ("intensity", light))
    }
    if "label" in by_range:
        first_ray = np.argmax(group[None] == at[..., None], axis=2)
        returns["label"] = np.where(exists, by_range["label"][beam, first_ray], -1)
    return returns


def _simulate_detection(returns: dict[str, np.ndarray], lidar: Lidar, random: np.random.Generator) -> None:
    """Apply the probability of detection, drop-outs, noise and the range limits to returns, in place."""
    ranges = returns["range"]
    detected = (ranges >= lidar.near) & (ranges <= lidar.far)
    if math.isfinite(lidar.detection_range):
        # signal relative to the signal at the detection range
        signal = (
            returns["intensity"]
            / _REFLECTIVITY
            * (lidar.detection_range / np.maximum(ranges, lidar.near)) ** 2
        )
        odds = _ODDS_AT_RANGE * np.square(np.square(signal))
        detected &= random.random(ranges.shape, np.float32) * (1 + odds) < odds
    if lidar.dropouts:
        detected &= random.random(ranges.shape, np.float32) >= lidar.dropouts
    if lidar.noise or lidar.noise_growth:
        noise = random.standard_normal(ranges.shape, np.float32)
        ranges += noise * (lidar.noise + lidar.noise_growth * ranges)
        detected &= (ranges >= lidar.near) & (ranges <= lidar.far)
    for name, values in returns.items():
        values[~detected] = -1 if name == "label" else 0
