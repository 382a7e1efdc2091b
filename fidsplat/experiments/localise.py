"""Localisation of a robot by tags in a greenhouse, with variants of its simulated camera."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Motion, Shutter, Trajectory
from fidsplat.capture.capture import Capture
from fidsplat.capture.sensor import Sensor
from fidsplat.experiments.ideal_tags import tag_depth_image
from fidsplat.render.renderer import Renderer
from fidsplat.scenes import PlacedMarker
from fidsplat.sim.localiser import Localiser
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.vision.detect import Detection, detect
from fidsplat.vision.pose import marker_pose
from fidsplat.vision.readback import corner_error
from fidsplat.worlds.greenhouse import AISLE, Greenhouse
from fidsplat.worlds.robot import BODY, Errors, Run, camera_at, drive

RATE = 4.0
"""images per second"""
DISTANCES = 1.0, 2.0, 3.0
"""distance bins of corner errors in metres"""
FAMILY = "apriltag:36h11"
CAMERA = "eye"
"""name of the camera in logs"""
_LENS = BrownConrady(k1=-0.18, k2=0.03, p1=0.0005, p2=-0.0003)
_SENSOR = Sensor(full_well=2000.0, read_noise=6.0, bits=8)


@dataclass(frozen=True)
class Variant:
    """Variant of the robot's camera and tags."""

    mixture: str | None = "exact"
    """mixture of the markers; None: no images"""
    lens: BrownConrady | None = None
    exposure_time: float = 0.0
    readout: float = 0.0
    sensor: Sensor | None = None
    ideal: bool = False
    """use the detected tags with ideal corners"""
    texture: bool = False
    """replace tag splats by the exact mean of the texture per pixel; pinhole camera without exposure time"""
    reach: float = math.inf
    """maximum distance of tags in metres"""
    speed: float | None = None
    """metres per second; None: that of the experiment"""

    @property
    def taken(self) -> Variant | None:
        """Key of the rendered images; None without images."""
        return None if self.mixture is None else replace(self, ideal=False, reach=math.inf)


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
}
"""variants by name: odometry only, ideal corners, mixtures, and effects, speeds and tag distances of
`exact`"""


@dataclass(frozen=True)
class Drive:
    """A robot's drive through a greenhouse. Raises InputError for an impossible greenhouse."""

    rows: int = 5
    """Number of rows of plants; 5 make a path of 60 m."""
    plants: int = 12
    """Number of plants in each row."""
    seed: int = 0
    """Seed of the plants and of the sensors' errors."""
    speed: float = 0.5
    """Speed in metres per second."""

    @cached_property
    def house(self) -> Greenhouse:
        """Greenhouse of the drive."""
        return Greenhouse(self.rows, self.plants, self.seed)

    @property
    def camera(self) -> Camera:
        """Camera of 640 x 480 pixels, 80 degrees wide."""
        return Camera.look_at(640, 480, math.radians(80), (0, 0, 0), (0, 0, 1))

    @cached_property
    def tags(self) -> dict[int, PlacedMarker]:
        """Placed tags by id."""
        return {placed.marker.id: placed for placed in self.house.markers if placed.marker.id is not None}

    def run(self, speed: float | None = None) -> Run:
        """Drive up one aisle and down the next, at a given or the default speed."""
        ends, path = (-0.8, self.house.length + 0.8), []
        for aisle in range(self.rows + 1):
            y = (aisle - 0.5) * AISLE
            path += [(x, y) for x in (ends if aisle % 2 == 0 else ends[::-1])]
        return drive(self.house.mjcf(BODY), np.array(path), speed or self.speed, Errors(seed=self.seed))

    def image_indices(self, run: Run) -> np.ndarray:
        """Indices of the poses with images."""
        return np.unique(np.searchsorted(run.times, np.arange(1 / RATE, run.times[-1], 1 / RATE)))

    def pictures(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[np.ndarray]:
        """Images (480, 640, 3) uint8 of the drive."""
        scene = replace(self.house, mixture=variant.mixture).scene
        if variant.texture:
            scene = replace(scene, markers=tuple(each for each in scene.markers if each.marker.id is None))
        plain = Capture(
            replace(self.camera, lens=variant.lens),
            background=scene.background,
            motion=Motion(run.camera.inverse()),
        )
        captures = []
        for k in self.image_indices(run):
            shutter = Shutter(
                float(run.times[k]), variant.exposure_time, 5, variant.readout, rows_per_band=30
            )
            sensor = None if variant.sensor is None else replace(variant.sensor, seed=int(k))
            captures.append(plain.with_(shutter=shutter, sensor=sensor))
        splats, tags = renderer.upload(scene), self.tags
        for capture, k, frame in zip(
            captures, self.image_indices(run), renderer.render_views(splats, captures), strict=True
        ):
            if variant.texture:
                ideal = tag_depth_image(tags.values(), camera_at(self.camera, run.poses[k]), frame["rgb"])
                frame = renderer.render(splats, capture.with_(external_depth=ideal))
            yield frame.to_uint8()

    def sightings(self, variant: Variant, run: Run, renderer: Renderer) -> Iterator[list[Detection]]:
        """Detected tags of each image; detection overlaps with rendering."""
        workers = os.cpu_count() or 1
        waiting = deque()
        with ThreadPoolExecutor(workers) as pool:
            for picture in self.pictures(variant, run, renderer):
                waiting.append(pool.submit(detect, picture, (FAMILY,), qr=False))
                if len(waiting) > 2 * workers:
                    yield interrupts.result_of(waiting.popleft())
            while waiting:
                yield interrupts.result_of(waiting.popleft())

    def localised(
        self,
        run: Run,
        sightings: list[list[Detection]] | None,
        camera: Camera,
        noise: float = 0.5,
        reach: float = math.inf,
    ) -> tuple[Trajectory, dict[str, Any]]:
        """Estimated poses and their errors.

        Args:
            sightings: detected tags of each image; None: no camera.
            noise: standard deviation of corners in pixels.
            reach: maximum distance of tags in metres.
        """
        first = run.poses[0]
        filtered = Localiser(np.array([*first[:2, 3], math.atan2(first[1, 0], first[0, 0])]), noise)
        tags = self.tags
        at = {} if sightings is None else dict(zip(self.image_indices(run).tolist(), sightings, strict=True))
        standing = partial(camera_at, camera)
        poses, seen = [first], 0
        for k in range(1, len(run.times)):
            filtered.move(run.wheels[k], float(run.gyro[k]), float(run.times[k] - run.times[k - 1]))
            for tag in at.get(k, []):
                if tag.id in tags and _away(tag, tags[tag.id], camera) <= reach:
                    seen += filtered.correct(tag.corners, tags[tag.id].corners, standing)
            poses.append(filtered.pose)
        facts = errors_of(run, np.array(poses))
        facts |= {"tags": seen, "refused": filtered.rejected}
        return Trajectory(run.times, np.array(poses)), facts

    def ideal(self, run: Run, sightings: list[list[Detection]]) -> list[list[Detection]]:
        """The detected tags with ideal corners."""
        tags, found = self.tags, []
        for k, codes in zip(self.image_indices(run).tolist(), sightings, strict=True):
            camera = camera_at(self.camera, run.poses[k])
            known = [(code, tags[code.id]) for code in codes if code.id is not None and code.id in tags]
            found.append([replace(code, corners=camera.project(tag.corners)) for code, tag in known])
        return found

    def corner_errors(
        self, run: Run, sightings: list[list[Detection]], camera: Camera
    ) -> list[dict[str, Any]]:
        """Number of detected tags and median corner error (root mean square per tag, pixels) by bin of
        `DISTANCES`."""
        tags, found = self.tags, []
        for k, codes in zip(self.image_indices(run).tolist(), sightings, strict=True):
            standing = camera_at(camera, run.poses[k])
            for code in codes:
                if code.id in tags:
                    away = np.linalg.norm(tags[code.id].pose[:3, 3] - standing.position)
                    off = corner_error(code, standing.project(tags[code.id].corners))
                    found.append((int(np.searchsorted(DISTANCES, away)), off))
        return [
            {"tags": len(own), "median_px": float(np.median(own)) if own else None}
            for own in ([off for place, off in found if place == k] for k in range(len(DISTANCES) + 1))
        ]


def _away(tag: Detection, placed: PlacedMarker, camera: Camera) -> float:
    """Distance of a tag in metres, from its corners."""
    return float(np.linalg.norm(marker_pose(tag.corners, placed.marker.size, camera)[:3, 3]))


def errors_of(run: Run, poses: np.ndarray) -> dict[str, float]:
    """Errors of estimated poses (n, 4, 4): ATE without alignment (root mean square and worst) and RPE over a
    metre (root mean square), in metres on the floor; heading in degrees."""
    off = np.linalg.norm(poses[:, :2, 3] - run.poses[:, :2, 3], axis=1)
    turn = np.einsum("nji,njk->nik", run.poses[:, :3, :3], poses[:, :3, :3])
    heading = np.degrees(np.arctan2(turn[:, 1, 0], turn[:, 0, 0]))
    gone = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(run.poses[:, :2, 3], axis=0), axis=1))])
    after = np.searchsorted(gone, gone + 1.0)
    pairs = np.flatnonzero(after < len(gone))
    steps = [np.linalg.inv(each[pairs]) @ each[after[pairs]] for each in (run.poses, poses)]
    relative = (np.linalg.inv(steps[0]) @ steps[1])[:, :2, 3]
    return {
        "ate_m": float(np.sqrt((off**2).mean())),
        "worst_m": float(off.max()),
        "rpe_m": float(np.sqrt((relative**2).sum(1).mean())) if len(pairs) else 0.0,
        "heading_deg": float(np.sqrt((heading**2).mean())),
    }


def write_log(
    asked: Drive, name: str, renderer: Renderer, path: str, overwrite: bool, source: str = ""
) -> Iterator[np.ndarray]:
    """Write the drive of a variant as a log: JPEG images, intrinsics, detections, gyroscope, camera poses
    (/tf) and estimated poses (/odom). Yields the logged images.

    Raises InputError for a variant without images, or if the log cannot be written.
    """
    from fidsplat.logs import RobotLog

    variant = VARIANTS[name]
    if variant.mixture is None:
        raise InputError(f"a logged variant must have images, e.g. exact, got {name!r}")
    run = asked.run()
    indices, camera = asked.image_indices(run), replace(asked.camera, lens=variant.lens)
    sightings = []
    with RobotLog(path, overwrite=overwrite, source=source) as log:
        for k, picture in zip(indices.tolist(), asked.pictures(variant, run, renderer), strict=True):
            time, codes = float(run.times[k]), detect(picture, (FAMILY,), qr=False)
            sightings.append(codes)
            log.image(time, CAMERA, picture, compress="jpeg")
            log.camera_info(time, CAMERA, camera)
            log.transform(time, CAMERA, run.camera.poses[k])
            log.detections(time, CAMERA, codes)
            yield picture
        path_taken, _ = asked.localised(run, sightings, camera)
        for k, time in enumerate(run.times.tolist()):
            log.imu(time, (0, 0, run.gyro[k]), frame="base_link")
            log.odometry(time, path_taken.poses[k])
