"""Localisation of a robot by tags and a LiDAR in a greenhouse, with variants of its simulated sensors."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Motion, Shutter, Trajectory
from fidsplat.capture.capture import Capture
from fidsplat.capture.lidar import Lidar
from fidsplat.capture.sensor import Sensor
from fidsplat.experiments.ideal_tags import tag_depth_image
from fidsplat.render.renderer import Renderer
from fidsplat.render.scan import scan
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.sim.localiser import Localiser
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.pose import marker_pose
from fidsplat.vision.readback import corner_error
from fidsplat.worlds import robot
from fidsplat.worlds.greenhouse import AISLE, Greenhouse
from fidsplat.worlds.robot import BODY, Errors, Run, camera_at

if TYPE_CHECKING:
    from fidsplat.logs import RobotLog

RATE = 4.0
"""images per second of the robot's camera"""
DISTANCES = 1.0, 2.0, 3.0
"""distance bins of corner errors in metres"""
FAMILY = "apriltag:36h11"
CAMERA, LIDAR = "eye", "lidar"
"""names of the sensors in logs"""
WHEELS, GYROSCOPE, CODES, POINTS = (
    "/joint_states",
    "/imu/data_raw",
    f"/{CAMERA}/detections",
    f"/{LIDAR}/points",
)
"""topics of the measurements"""
_LENS = BrownConrady(k1=-0.18, k2=0.03, p1=0.0005, p2=-0.0003)
_SENSOR = Sensor(full_well=2000.0, read_noise=6.0, bits=8)


@dataclass(frozen=True)
class Variant:
    """Variant of the robot's sensors and tags."""

    mixture: str | None = "exact"
    """mixture of the markers; None: no images"""
    lens: BrownConrady | None = None
    exposure_time: float = 0.0
    readout: float = 0.0
    sensor: Sensor | None = None
    ideal: bool = False
    """replace the corners of detected tags by ideal corners"""
    texture: bool = False
    """render tags as the exact mean of their texture per pixel instead of splats (pinhole, no exposure
    time)"""
    reach: float = math.inf
    """maximum distance of tags in metres"""
    speed: float | None = None
    """metres per second; None: the drive's speed"""
    lidar: bool = False
    """scan with a LiDAR at the times of the images"""
    without: str = ""
    """sensor that the filter ignores: wheels, gyroscope, tags or lidar"""
    spacing: float = 0.0
    """minimum distance in metres between the used tags on a side of a bench"""

    @property
    def rendering(self) -> Variant:
        """The variant with only the settings that change the logged measurements."""
        return replace(self, ideal=False, reach=math.inf, without="", spacing=0.0)


VARIANTS = {
    "odometry": Variant(mixture=None),
    "ideal corners": Variant(ideal=True),
    "exact": Variant(),
    "ideal texture": Variant(texture=True),
    "fitted": Variant("fitted"),
    "paper": Variant("paper"),
    "lens": Variant(lens=_LENS),
    "blur": Variant(exposure_time=0.03),
    "rolling shutter": Variant(readout=0.03),
    "noise": Variant(sensor=_SENSOR),
    "all of these": Variant("exact", _LENS, 0.03, 0.03, _SENSOR),
    "0.25 m/s, blur": Variant(exposure_time=0.03, speed=0.25),
    "1 m/s, blur": Variant(exposure_time=0.03, speed=1.0),
    "up to 1 m": Variant(reach=1.0),
    "up to 2 m": Variant(reach=2.0),
    "all sensors": Variant(lidar=True),
    "no wheels": Variant(lidar=True, without="wheels"),
    "no gyroscope": Variant(lidar=True, without="gyroscope"),
    "no tags": Variant(lidar=True, without="tags"),
    "no LiDAR": Variant(lidar=True, without="lidar"),
    "sparse tags, no wheels": Variant(lidar=True, without="wheels", spacing=3.0),
}
"""variants by name: odometry only, ideal corners, mixtures, effects, speeds and tag distances of `exact`, and
a LiDAR without each sensor in turn"""
SENSORS = "odometry", *(name for name, variant in VARIANTS.items() if variant.lidar)
"""variants that omit each sensor in turn"""


@dataclass(frozen=True)
class Drive:
    """A robot's drive through a greenhouse.

    Raises:
        InputError: an impossible greenhouse.
    """

    rows: int = 5
    """Number of rows of plants; 5 make a path of 60 m."""
    plants: int = 12
    """Number of plants in each row."""
    seed: int = 0
    """Seed of the greenhouse and of the sensors' errors."""
    speed: float = 0.5
    """Speed of the robot in metres per second."""

    @cached_property
    def house(self) -> Greenhouse:
        return Greenhouse(self.rows, self.plants, self.seed)

    @property
    def camera(self) -> Camera:
        """Camera of 640 x 480 pixels, 80 degrees wide."""
        return Camera.look_at(640, 480, math.radians(80), (0, 0, 0), (0, 0, 1))

    @cached_property
    def tags(self) -> dict[int, PlacedMarker]:
        """Placed tags by id."""
        return {placed.marker.id: placed for placed in self.house.markers if placed.marker.id is not None}

    def scene(self, mixture: str | None) -> Scene:
        """The greenhouse with markers of a mixture."""
        return replace(self.house, mixture=mixture).scene

    def run(self, speed: float | None = None) -> Run:
        """Drive up one aisle and down the next; speed: None for the drive's speed."""
        ends, path = (-0.8, self.house.length + 0.8), []
        for aisle in range(self.rows + 1):
            y = (aisle - 0.5) * AISLE
            path += [(x, y) for x in (ends if aisle % 2 == 0 else ends[::-1])]
        return robot.drive(self.house.mjcf(BODY), np.array(path), speed or self.speed, Errors(seed=self.seed))

    def image_indices(self, run: Run) -> np.ndarray:
        """Indices of the poses at which images are rendered."""
        return np.unique(np.searchsorted(run.times, np.arange(1 / RATE, run.times[-1], 1 / RATE)))

    def images(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[np.ndarray]:
        """Images (480, 640, 3) uint8 of the drive."""
        scene = self.scene(variant.mixture)
        if variant.texture:
            scene = replace(
                scene, markers=tuple(placed for placed in scene.markers if placed.marker.id is None)
            )
        camera, motion = replace(self.camera, lens=variant.lens), Motion(run.camera.inverse())
        base = Capture(camera, background=scene.background, motion=motion)
        indices = self.image_indices(run).tolist()
        captures = [
            base.with_(
                shutter=Shutter(
                    float(run.times[k]), variant.exposure_time, 5, variant.readout, rows_per_band=30
                ),
                sensor=None if variant.sensor is None else replace(variant.sensor, seed=k),
            )
            for k in indices
        ]
        resident = renderer.upload(scene)
        frames = renderer.render_views(resident, captures)
        for capture, k, frame in zip(captures, indices, frames, strict=True):
            if variant.texture:
                camera = camera_at(self.camera, run.poses[k])
                ideal = tag_depth_image(self.tags.values(), camera, frame["rgb"])
                frame = renderer.render(resident, capture.with_(external_depth=ideal))
            yield frame.to_uint8()

    def frames(
        self, variant: Variant, run: Run, renderer: Renderer
    ) -> Iterator[tuple[np.ndarray, list[Detection]]]:
        """Images and their detected tags. Detection runs in threads during rendering."""
        workers = os.cpu_count() or 1
        with ThreadPoolExecutor(workers) as pool:
            work = lambda image: (image, detect(image, (FAMILY,), qr=False))  # noqa: E731
            futures = (pool.submit(work, image) for image in self.images(variant, run, renderer))
            yield from interrupts.ordered_results(futures, 2 * workers)

    def detections(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[list[Detection]]:
        """Detected tags of each image."""
        return (codes for _, codes in self.frames(variant, run, renderer))

    def scans(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[np.ndarray]:
        """Point cloud (`Scan.cloud`) of a VLP-16 at 20 scans per second (900 columns), for each image."""
        lidar = Lidar.preset("vlp-16", rate=20.0, seed=self.seed)
        lidar = replace(lidar, pattern=replace(lidar.pattern, columns=900))
        resident = renderer.upload(self.scene(variant.mixture))
        for k in self.image_indices(run).tolist():
            pose = run.poses[k] @ rigid_matrix(robot.LIDAR_AT)
            yield scan(resident, lidar, pose, renderer=renderer, index=k).cloud()

    def localise(
        self,
        run: Run,
        detections: list[list[Detection]] | None,
        camera: Camera,
        noise: float = 0.5,
        scans: list[np.ndarray] | None = None,
        variant: Variant | None = None,
    ) -> tuple[Trajectory, dict[str, Any]]:
        """Estimate poses by the filter; returns them with their errors.

        Args:
            detections: detected tags of each image; None: no camera.
            noise: standard deviation of corners in pixels.
            scans: points (n, 3) of each scan; None: no LiDAR.
            variant: its maximum distance and spacing of tags, and the ignored sensor.
        """
        variant = variant or Variant()
        without, tags = variant.without, self._tags_with_spacing(variant.spacing)
        first = run.poses[0]
        localiser = Localiser(
            np.array([*first[:2, 3], math.atan2(first[1, 0], first[0, 0])]),
            noise,
            drift=0.1 if without == "wheels" else 0.0,
            # wheels of different size rotate the robot in proportion to its speed
            **({"bias": 0.05, "bias_walk": 0.02} if without == "gyroscope" else {}),
        )
        used_codes = None if without == "tags" else detections
        by_pose = {} if used_codes is None else {k: codes for k, codes, _ in self._known(run, used_codes)}
        clouds = {}
        if scans and without != "lidar":
            from fidsplat.sim.scan_matching import ScanMatcher  # here, since it needs another package

            matcher = ScanMatcher(robot.LIDAR_AT[2])
            clouds = dict(zip(self.image_indices(run), scans, strict=True))
        poses, used, matched, speed, last = [first], 0, 0, 0.0, 0
        for k in range(1, len(run.times)):
            seconds = float(run.times[k] - run.times[k - 1])
            wheels = np.full(2, speed * seconds) if without == "wheels" else run.wheels[k]
            rate = float(wheels[1] - wheels[0]) / robot.TRACK / seconds
            localiser.move(wheels, rate if without == "gyroscope" else float(run.gyro[k]), seconds)
            for code, tag in by_pose.get(k, []):
                pose = marker_pose(code.corners, tag.marker.size, camera)
                if np.linalg.norm(pose[:3, 3]) <= variant.reach and code.id in tags:
                    used += localiser.correct(code.corners, tag.corners, partial(camera_at, camera))
            if k in clouds:
                matched += matcher.correct(localiser, clouds[k])
                # without wheels, the speed is estimated from the last scan
                ahead = np.linalg.inv(poses[last]) @ localiser.pose
                speed, last = float(ahead[0, 3] / (run.times[k] - run.times[last])), k
            poses.append(localiser.pose)
        facts = errors_of(run, np.array(poses))
        facts |= {"tags": used, "scans": matched, "refused": localiser.rejected}
        return Trajectory(run.times, np.array(poses)), facts

    def _tags_with_spacing(self, spacing: float) -> set[int]:
        """Ids of tags with at least this distance from each other on each side of a bench."""
        ids, last = set(), {}
        for number, tag in sorted(self.tags.items(), key=lambda item: item[1].pose[0, 3]):
            x, side = tag.pose[0, 3], round(tag.pose[1, 3], 3)
            if x >= last.get(side, -math.inf) + spacing:
                ids.add(number)
                last[side] = x
        return ids

    def _known(
        self, run: Run, detections: list[list[Detection]]
    ) -> Iterator[tuple[int, list[tuple[Detection, PlacedMarker]], np.ndarray]]:
        """Pose index, detections with their tags, and robot pose of each image."""
        for k, codes in zip(self.image_indices(run).tolist(), detections, strict=True):
            yield k, [(code, self.tags[code.id]) for code in codes if code.id in self.tags], run.poses[k]

    def ideal_corners(self, run: Run, detections: list[list[Detection]]) -> list[list[Detection]]:
        """Detected tags with corners projected from the true pose."""
        return [
            [replace(code, corners=camera_at(self.camera, pose).project(tag.corners)) for code, tag in pairs]
            for _, pairs, pose in self._known(run, detections)
        ]

    def corner_errors(
        self, run: Run, detections: list[list[Detection]], camera: Camera
    ) -> list[dict[str, Any]]:
        """Number of detected tags and median corner error in pixels, by bin of `DISTANCES`.

        The corner error of a tag is the RMS over its corners.
        """
        errors: list[list[float]] = [[] for _ in range(len(DISTANCES) + 1)]
        for _, pairs, pose in self._known(run, detections):
            at = camera_at(camera, pose)
            for code, tag in pairs:
                distance = np.linalg.norm(tag.pose[:3, 3] - at.position)
                error = corner_error(code, at.project(tag.corners))
                errors[np.searchsorted(DISTANCES, distance)].append(error)
        return [
            {
                "tags": len(errors_of_tag),
                "median_px": float(np.median(errors_of_tag)) if errors_of_tag else None,
            }
            for errors_of_tag in errors
        ]


def errors_of(run: Run, poses: np.ndarray) -> dict[str, float]:
    """Errors of estimated poses (n, 4, 4): metres on the floor, heading in degrees.

    ATE without alignment (RMS and maximum), RPE over one metre (RMS).
    """
    distance = np.linalg.norm(poses[:, :2, 3] - run.poses[:, :2, 3], axis=1)
    rotation = np.einsum("nji,njk->nik", run.poses[:, :3, :3], poses[:, :3, :3])
    heading = np.degrees(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    steps = np.linalg.norm(np.diff(run.poses[:, :2, 3], axis=0), axis=1)
    travelled = np.concatenate([[0], np.cumsum(steps)])
    after = np.searchsorted(travelled, travelled + 1.0)
    pairs = np.flatnonzero(after < len(travelled))
    true, estimated = (
        np.linalg.inv(matrices[pairs]) @ matrices[after[pairs]] for matrices in (run.poses, poses)
    )
    relative = (np.linalg.inv(true) @ estimated)[:, :2, 3]
    return {
        "ate_m": float(np.sqrt((distance**2).mean())),
        "worst_m": float(distance.max()),
        "rpe_m": float(np.sqrt((relative**2).sum(1).mean())) if len(pairs) else 0.0,
        "heading_deg": float(np.sqrt((heading**2).mean())),
    }


def record(
    drive: Drive, variant: Variant, run: Run, renderer: Renderer, log: RobotLog, images: bool = False
) -> Iterator[tuple[np.ndarray, list[Detection]]]:
    """Log the measurements of a drive as ROS 2 messages; yields images and detected tags.

    The messages are wheels, gyroscope, intrinsics, detections, points, camera poses (/tf), and if requested
    images as JPEG.
    """
    has_images = variant.mixture is not None
    frames = drive.frames(variant, run, renderer) if has_images else iter(())
    scans = drive.scans(variant, run, renderer) if variant.lidar else iter(())
    camera, angles = replace(drive.camera, lens=variant.lens), run.wheels.cumsum(0) / robot.WHEEL
    shown = set(drive.image_indices(run).tolist() if has_images else ())
    for k, time in enumerate(run.times.tolist()):
        log.imu(time, (0, 0, run.gyro[k]), frame="base_link")
        log.joint_states(time, ("left", "right"), angles[k])
        if k in shown:
            image, codes = next(frames)
            if images:
                log.image(time, CAMERA, image, compress="jpeg")
            log.camera_info(time, CAMERA, camera)
            log.camera_pose(time, CAMERA, run.camera.poses[k], base=run.poses[k])
            log.detections(time, CAMERA, codes)
            for points in itertools.islice(scans, 1):
                log.transform(time, LIDAR, rigid_matrix(robot.LIDAR_AT), parent="base_link")
                log.points(time, LIDAR, points)
            yield image, codes


def recorded(path: str | os.PathLike[str], truth: Run) -> tuple[Run, list[list[Detection]], list[np.ndarray]]:
    """Read a ROS 2 log: wheels and gyroscope with the true poses, detected tags, and points (n, 3).

    Raises:
        InputError: the file is not a log.
    """
    from fidsplat.logs import messages
    from fidsplat.logs.reader import detections_of, points_of

    gyro, angles, codes, scans = [], [], [], []
    for topic, message in messages(path, WHEELS, GYROSCOPE, CODES, POINTS):
        if topic == GYROSCOPE:
            gyro.append(message.angular_velocity.z)
        elif topic == WHEELS:
            angles.append(message.position)
        elif topic == CODES:
            codes.append(detections_of(message))
        else:
            scans.append(points_of(message))
    wheels = robot.WHEEL * np.diff(angles, axis=0, prepend=0)
    return replace(truth, wheels=wheels, gyro=np.array(gyro)), codes, scans


def write_log(
    drive: Drive, name: str, renderer: Renderer, path: str, overwrite: bool, source: str = ""
) -> Iterator[np.ndarray]:
    """Render the drive in a variant of the experiment, and write a log with its images and estimated poses
    (/odom); yields the images.

    Raises:
        InputError: the variant has no images, or the log cannot be written.
    """
    from fidsplat.logs import RobotLog

    variant = VARIANTS[name]
    if variant.mixture is None:
        raise InputError(f"a logged variant must have images, e.g. exact, got {name!r}")
    run, detections = drive.run(), []
    with RobotLog(path, up=(0, 0, 1), overwrite=overwrite, source=source) as log:
        for image, codes in record(drive, variant, run, renderer, log, images=True):
            detections.append(codes)
            yield image
        estimate, _ = drive.localise(run, detections, replace(drive.camera, lens=variant.lens))
        for k, time in enumerate(run.times.tolist()):
            log.odometry(time, estimate.poses[k])
