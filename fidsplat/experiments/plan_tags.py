"""Planning of tag positions on surfaces of a scene, for the localisation of a camera along a trajectory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fidsplat.cameras import Camera, Trajectory
from fidsplat.capture.sensor import Sensor
from fidsplat.images.tag_dictionaries import families, parse_family
from fidsplat.markers import Marker, marker
from fidsplat.render.renderer import Renderer
from fidsplat.render.surface import median_depth_capture, surface_from_depth
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.surface import Surface
from fidsplat.scenes.up import scene_up
from fidsplat.util.errors import InputError
from fidsplat.util.files import write_json
from fidsplat.util.progress import Progress, no_progress
from fidsplat.vision.fisher_information import CornerNoise, tag_information
from fidsplat.vision.tag_placement import (
    Objective,
    Selection,
    Sightings,
    error_gain,
    gain,
    greedy,
    local_search,
    odometry_covariance,
    planar_information,
    position_error,
    updated,
)

WIDEST = 640
"""maximum width of the depth images in pixels"""
STEPS, ROWS = 16, 12
"""number of candidates per image along x and y"""
MODULE = 2.5
"""minimum size in pixels of a module of a readable tag"""
INCIDENCE = math.cos(math.radians(70))
"""minimum cosine of the angle between the normal of a readable tag and the ray"""
TAGS = ("apriltag", "aruco")
"""kinds of markers from which a camera localises itself"""
STEEP = math.sqrt(0.5)
"""maximum cosine of the angle between the normal of a wall and the vertical"""
FLAT = 0.1
"""maximum roughness of a candidate, relative to the size of the tag"""
MIN_INLIERS = 0.9
"""minimum fraction of the tag's area that is in the plane"""
_DEPTH = 0.02, 0.01
"""tolerance of the occlusion test in metres and as a fraction of the distance: nearer depths occlude a tag"""


OBJECTIVES: dict[str, Objective] = {"information": gain, "error": error_gain}


@dataclass(frozen=True)
class PlanSettings:
    """Settings of a plan.

    Raises:
        InputError: a value out of range.
    """

    count: int = 10
    """N: number of tags"""
    size: float = 0.16
    """M: edge of a tag in metres"""
    family: str = "36h11"
    """TEXT: AprilTag family; ids of existing tags are skipped"""
    target: float | None = None
    """M: place tags, at most N, until the predicted RMS error of positions is below this"""
    walls: bool = False
    """use walls only, no floors and ceilings"""
    objective: Literal["information", "error"] = "information"
    """information|error: maximise the information, with an upper bound of the optimum, or minimise the
    predicted error of the positions"""
    planar: bool = False
    """the camera moves on a floor: height, roll and pitch do not drift, with errors of 3 mm and 0.3
    degrees"""
    poses: int = 150
    """N: number of evaluated poses of the trajectory, equidistant in time"""
    views: int = 30
    """N: number of poses whose depth images are searched for surfaces"""
    drift: tuple[float, float] = (0.01, 0.5)
    """M DEG: standard deviation of the odometry after one metre"""
    corner_noise: float = 0.05
    """PX: error of a detected corner in addition to the effects of blur and sensor noise"""

    def __post_init__(self) -> None:
        for name in ("count", "poses", "views"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name} must be at least 1, got {getattr(self, name)}")
        for name in ("size", "corner_noise"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"--{name.replace('_', '-')} must be above 0, got {getattr(self, name)}")
        if not (self.target is None or 0 < self.target < math.inf):
            raise InputError(f"--target must be a positive length in metres, got {self.target}")
        if len(self.drift) != 2 or not all(0 < value < math.inf for value in self.drift):
            raise InputError(f"--drift must be metres and degrees, both above 0, got {self.drift}")


@dataclass(frozen=True, eq=False)
class Plan:
    """Scene with planned tags."""

    scene: Scene
    """scene with the tags after its own markers"""
    tags: tuple[PlacedMarker, ...]
    """planned tags, in the order of the greedy selection"""
    sightings: tuple[int, ...]
    """number of evaluated poses from which each tag is readable"""
    errors: tuple[float, ...]
    """predicted RMS error of the positions in metres, without planned tags, with the first tag, ..."""
    selection: Selection
    candidates: int
    """number of candidates that are visible from a pose"""
    path: np.ndarray
    """(p, 4, 4) evaluated camera-to-world poses"""

    def facts(self) -> dict[str, Any]:
        """Plain data of the plan."""
        rows = [
            {"spec": tag.marker.spec, "position": tag.pose[:3, 3].tolist(), "poses": seen, "error_m": error}
            for tag, seen, error in zip(self.tags, self.sightings, self.errors[1:], strict=True)
        ]
        facts: dict[str, Any] = {"tags": rows, "error_without_m": self.errors[0]}
        facts |= {"error_m": self.errors[-1], "candidates": self.candidates, "poses": len(self.path)}
        value, bound = self.selection.value, self.selection.bound
        return facts | {"objective": value, "bound": bound if math.isfinite(bound) else None}


def plan_tags(
    scene: Scene,
    path: Trajectory,
    settings: PlanSettings,
    renderer: Renderer,
    progress: Progress | None = None,
) -> Plan:
    """Plan tags on surfaces of a scene for a camera on a trajectory.

    Candidates are flat surfaces in view of the trajectory. A tag is readable from a pose if its depth image
    has no occlusion, its modules are large enough and its incidence is below 70 degrees. The information of
    the corners depends on incidence, distance, motion blur and noise. Existing tags of the scene contribute.

    Args:
        path: camera-to-world poses.
        progress: called with the current step and its completed fraction.

    Raises:
        InputError: the scene has no camera, no flat surface is in view of the trajectory, or the family has
            too few ids.
    """
    ids = _free_ids(scene, settings)
    survey = Survey(scene, path, settings, renderer, progress)
    poses = survey.candidate_poses()
    tag = survey.tag
    sightings = survey.sightings([PlacedMarker(tag, pose) for pose in poses])
    visible = [k for k, sighting in enumerate(sightings) if len(sighting.poses)]
    if not visible:
        raise InputError(
            "a flat surface of a tag's size must be in view from the trajectory, at an incidence below 70 "
            "degrees, got none; " + survey.remedy(poses)
        )
    sightings, poses = [sightings[k] for k in visible], poses[visible]
    conflicts = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2) < 2.2 * tag.radius
    np.fill_diagonal(conflicts, False)
    covariance, target = survey.covariance, settings.target or 0.0
    objective = OBJECTIVES[settings.objective]
    survey.report("selecting", 0.8)
    selection = greedy(
        covariance,
        sightings,
        settings.count,
        conflicts,
        lambda now: position_error(now) <= target,
        objective,
    )
    if settings.target is None:
        selection = local_search(covariance, sightings, selection, conflicts, objective)
    errors = [position_error(covariance)]
    for k in selection.chosen:
        covariance = updated(covariance, sightings[k])
        errors.append(position_error(covariance))
    planned = tuple(
        PlacedMarker(marker(f"apriltag:{settings.family}:{ids[number]}", settings.size), poses[k])
        for number, k in enumerate(selection.chosen)
    )
    survey.report("selecting", 1.0)
    return Plan(
        replace(scene, markers=(*scene.markers, *planned)),
        planned,
        tuple(len(sightings[k].poses) for k in selection.chosen),
        tuple(errors),
        selection,
        len(sightings),
        survey.path,
    )


class Survey:
    """Depth images along a trajectory, and the covariance of the trajectory with the scene's own tags."""

    def __init__(
        self,
        scene: Scene,
        path: Trajectory,
        settings: PlanSettings,
        renderer: Renderer,
        progress: Progress | None = None,
    ) -> None:
        self.report = progress or no_progress
        self._scene, self._settings, camera = scene, settings, _camera(scene)
        count = settings.poses if len(path) > 1 else 1
        times = np.linspace(float(path.times[0]), float(path.times[-1]), count)
        self.cameras = [camera.with_pose(camera_to_world=path(float(time))) for time in times]
        self._exposure_cameras = _exposure_cameras(scene, camera, path, times)
        self._depths = []
        for k, frame in enumerate(_depth_frames(scene, self.cameras, renderer)):
            self._depths.append(frame["depth_first"])
            self.report("rendering depth", 0.3 * (k + 1) / count)
        self.tag = marker(f"apriltag:{settings.family}:0", settings.size)
        self.up = scene_up(scene)
        self.path = np.array([camera.camera_to_world for camera in self.cameras])
        drift = settings.drift[0], math.radians(settings.drift[1])
        self.covariance = odometry_covariance(self.path, *drift, up=self.up if settings.planar else None)
        existing = [
            placed for placed in scene.markers if placed.motion is None and placed.marker.kind in TAGS
        ]
        self.covariance = self.with_tags(existing)

    def candidate_poses(self) -> np.ndarray:
        """Poses (n, 4, 4) of tags on flat surfaces, except at the scene's markers."""
        settings, candidates = self._settings, []
        every = range(0, len(self.cameras), max(1, -(-len(self.cameras) // settings.views)))
        for n, k in enumerate(every):
            surfaces = surface_candidates(self._depths[k], _depth_camera(self.cameras[k]), self.tag, self.up)
            candidates += [
                (surface, pose)
                for surface, pose in surfaces
                if not settings.walls or abs(surface.normal @ self.up) < STEEP
            ]
            self.report("searching surfaces", 0.3 + 0.4 * (n + 1) / len(every))
        poses = suppress_nearby(candidates, self.tag)
        for placed in self._scene.markers:  # markers are flat surfaces too
            distances = np.linalg.norm(poses[:, :3, 3] - placed.pose[:3, 3], axis=1)
            poses = poses[distances > self.tag.radius + placed.marker.radius]
        return poses

    def remedy(self, poses: np.ndarray) -> str:
        """What to change if none of the candidates (n, 4, 4) is readable."""
        camera = self.cameras[0]
        if len(poses):
            between = poses[:, None, :3, 3] - self.path[None, :, :3, 3]
            nearest = float(np.linalg.norm(between, axis=2).min())
        else:
            nearest = min(
                (float(depth[depth > 0].min()) for depth in self._depths if depth.any()), default=0.0
            )
        size, sides = self.tag.size, self.tag.bits.shape[1]
        pixels = size * max(camera.fx, camera.fy) / (sides * nearest) if nearest else math.inf
        if pixels < MODULE:
            return (
                f"{nearest:.3g} m away, a module of a tag has {pixels:.2g} pixels of the {MODULE:g} that are "
                f"needed: give larger tags, --size {size * MODULE / pixels:.2g} or more"
            )
        return "give smaller tags, or poses of the camera (z forward, y down)"

    def sightings(self, tags: Sequence[PlacedMarker]) -> list[Sightings]:
        """Images in which each tag is readable."""
        noise = corner_noise(self._scene.sensor or Sensor(), self._settings.corner_noise)
        sightings = sightings_of(tags, self.cameras, self._depths, noise, self._exposure_cameras)
        if not self._settings.planar:
            return sightings
        return [
            Sightings(
                sighting.poses, planar_information(sighting.information, self.path[sighting.poses], self.up)
            )
            for sighting in sightings
        ]

    def with_tags(self, tags: Sequence[PlacedMarker]) -> np.ndarray:
        """Covariance (6 p, 6 p) of the trajectory, updated by tags."""
        covariance = self.covariance
        for sighting in self.sightings(tags):
            covariance = updated(covariance, sighting)
        return covariance


def corner_noise(sensor: Sensor, floor: float) -> CornerNoise:
    """Corner noise for a sensor, at half of its full well."""
    steps = 2.0 ** (sensor.bits or 8) - 1
    noise = (1 / steps) ** 2 / 12
    if math.isfinite(sensor.full_well):
        noise += (0.5 * sensor.full_well + sensor.read_noise**2) / sensor.full_well**2
    return CornerNoise(floor, math.sqrt(noise))


def surface_candidates(
    depth: np.ndarray, camera: Camera, tag: Marker, up: np.ndarray
) -> list[tuple[Surface, np.ndarray]]:
    """Flat surfaces of a tag's size in a depth image, each with the pose (4, 4) of a tag on it."""
    candidates = []
    view = camera.world_to_camera
    for y in (np.arange(ROWS) + 0.5) * camera.height / ROWS:
        for x in (np.arange(STEPS) + 0.5) * camera.width / STEPS:
            distance = float(depth[int(y), int(x)])
            if distance <= 0:
                continue
            radius = tag.radius * max(camera.fx, camera.fy) / distance
            if radius < 4 or radius > camera.width / 4:
                continue
            try:
                surface = surface_from_depth(depth, camera, (x, y), radius)
            except InputError:
                continue
            if surface.inlier_fraction >= MIN_INLIERS and surface.roughness <= FLAT * tag.size:
                candidates.append((surface, surface.pose([up, -view[1, :3], view[2, :3]])))
    return candidates


def suppress_nearby(candidates: Sequence[tuple[Surface, np.ndarray]], tag: Marker) -> np.ndarray:
    """Poses (n, 4, 4) of candidates; of nearby ones only that with the largest inlier fraction remains."""
    order = sorted(
        range(len(candidates)), key=lambda k: (-candidates[k][0].inlier_fraction, candidates[k][0].roughness)
    )
    chosen: list[np.ndarray] = []
    for k in order:
        pose = candidates[k][1]
        near = [place for place in chosen if np.linalg.norm(place[:3, 3] - pose[:3, 3]) < tag.size]
        if not any(place[:3, 2] @ pose[:3, 2] > 0.8 for place in near):
            chosen.append(pose)
    return np.array(chosen).reshape(-1, 4, 4)


def sightings_of(
    tags: Sequence[PlacedMarker],
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    noise: CornerNoise,
    exposed: Sequence[tuple[Camera, Camera]] | None = None,
) -> list[Sightings]:
    """Images in which each tag is readable.

    Args:
        depths: (h, w) median depth of each camera, at most 640 pixels wide.
        exposed: each camera at the start and the end of the exposure; None: an instantaneous shutter.
    """
    if not tags:
        return []
    corners = np.array([tag.corners for tag in tags])
    middles, normals = corners.mean(1), np.array([-tag.pose[:3, 2] for tag in tags])
    sides = np.array([tag.marker.bits.shape[1] for tag in tags])
    margin = np.array([tag.marker.radius * math.sqrt(2) / tag.marker.size for tag in tags])
    u = np.linspace(-1, 1, 5)
    grid = np.stack(np.meshgrid(u, u), -1).reshape(-1, 2) / 2
    across, down = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0]
    samples = margin[:, None, None] * (
        grid[None, :, :1] * across[:, None] + grid[None, :, 1:] * down[:, None]
    )
    samples = samples + middles[:, None]
    poses: list[list[int]] = [[] for _ in tags]
    known: list[list[np.ndarray]] = [[] for _ in tags]
    for k, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        rays = camera.position - middles
        distances = np.linalg.norm(rays, axis=1)
        facing = (rays * normals).sum(1) / np.maximum(distances, 1e-9) >= INCIDENCE
        visible = np.flatnonzero(facing)
        if not len(visible):
            continue
        pixels = camera.project(samples[visible].reshape(-1, 3)).reshape(len(visible), -1, 2)
        code = camera.project(corners[visible].reshape(-1, 3)).reshape(-1, 4, 2)
        with np.errstate(invalid="ignore"):
            inside = ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all((1, 2))
            edge = np.linalg.norm(np.roll(code, -1, axis=1) - code, axis=2).min(1)
        readable = np.flatnonzero(inside & (edge >= MODULE * sides[visible]))
        readable = readable[_visible(camera, depth, samples[visible[readable]])]
        visible = visible[readable]
        if not len(visible):
            continue
        moved = None
        if exposed is not None:
            begin, end = (camera_at.project(corners[visible].reshape(-1, 3)) for camera_at in exposed[k])
            moved = np.nan_to_num(end - begin).reshape(-1, 4, 2)
        matrices = tag_information(camera, corners[visible], noise, moved)
        for tag, information in zip(visible, matrices, strict=True):
            poses[tag].append(k)
            known[tag].append(information)
    return [
        Sightings(np.array(numbers, int), np.array(matrices).reshape(-1, 6, 6))
        for numbers, matrices in zip(poses, known, strict=True)
    ]


def _visible(camera: Camera, depth: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Whether all samples (n, m, 3) of a tag are in front of the depth image, within the tolerance."""
    image = _depth_camera(camera)
    flat = samples.reshape(-1, 3)
    x, y = np.clip(image.project(flat).astype(int), 0, (image.width - 1, image.height - 1)).T
    measured = depth[y, x]
    local = flat - image.position
    along_ray = image.lens is not None and image.lens.along_ray
    expected = np.linalg.norm(local, axis=1) if along_ray else local @ image.world_to_camera[2, :3]
    hidden = (measured > 0) & (measured < expected - _DEPTH[0] - _DEPTH[1] * expected)
    return ~np.any(np.reshape(hidden, samples.shape[:2]), axis=1)


def _camera(scene: Scene) -> Camera:
    if scene.camera is None:
        raise InputError("the scene of plan-tags must have a camera, got none; add a [camera] table")
    return scene.camera


def _depth_camera(camera: Camera) -> Camera:
    """The camera of the depth images, at most `WIDEST` pixels wide."""
    if camera.width <= WIDEST:
        return camera
    return camera.with_size(WIDEST, max(1, round(camera.height * WIDEST / camera.width)))


def _depth_frames(scene: Scene, cameras: Sequence[Camera], renderer: Renderer):
    still = median_depth_capture(scene.capture)
    captures = [replace(still, camera=_depth_camera(camera)) for camera in cameras]
    return renderer.render_views(renderer.upload(scene), captures)


def _exposure_cameras(
    scene: Scene, camera: Camera, path: Trajectory, times: np.ndarray
) -> list[tuple[Camera, Camera]] | None:
    half = 0.0 if scene.shutter is None else scene.shutter.exposure_time / 2
    if not half:
        return None
    return [
        (
            camera.with_pose(camera_to_world=path(float(time) - half)),
            camera.with_pose(camera_to_world=path(float(time) + half)),
        )
        for time in times
    ]


def _free_ids(scene: Scene, settings: PlanSettings) -> list[int]:
    """Ids of the family that the scene does not use. Raises InputError if there are too few."""
    kind, family = parse_family(f"apriltag:{settings.family}")
    used = {placed.marker.id for placed in scene.markers if placed.marker.family == family}
    free = [number for number in range(families(kind)[family].count) if number not in used]
    if len(free) < settings.count:
        raise InputError(
            f"--count must be at most {len(free)}, the free ids of {family}, got {settings.count}; "
            "give another --family"
        )
    return free


def write_plan(plan: Plan, folder: Path, size: float) -> list[Path]:
    """Write scene.toml, plan.json and map.svg into a folder; returns these files."""

    plan.scene.save(folder / "scene.toml")
    write_json(folder / "plan.json", plan.facts(), indent=2)
    _write_map(plan, folder / "map.svg", size)
    return [folder / name for name in ("scene.toml", "plan.json", "map.svg")]


def _write_map(plan: Plan, file: Path, size: float) -> None:
    """Write a map of trajectory and tags from above, with a chart of the predicted error by number of
    tags."""
    from fidsplat.experiments.charts import COLORS, chart, plain_ticks
    from fidsplat.splats.statistics import level_rotation

    level = level_rotation(scene_up(plan.scene))
    flat = level[:, [0, 2]]  # right and ahead
    with chart(file, panels=2, size=(11.0, 4.6), one_scale=False) as (_, axes):
        path = plan.path[:, :3, 3] @ flat
        axes[0].plot(path[:, 0], path[:, 1], color="#bbbbbb", linewidth=2.0)
        for tag in plan.tags:
            (x, y), normal = tag.pose[:3, 3] @ flat, -tag.pose[:3, 2] @ flat
            axes[0].plot([x, x + 2 * size * normal[0]], [y, y + 2 * size * normal[1]], color=COLORS[4])
            axes[0].plot([x], [y], "s", color=COLORS[4], markersize=4)
            axes[0].annotate(
                str(tag.marker.id), (x, y), fontsize=7, xytext=(3, 3), textcoords="offset points"
            )
        axes[0].set_aspect("equal", adjustable="datalim")
        axes[0].set_xlabel("[m], from above")
        axes[1].plot(range(len(plan.errors)), 100 * np.array(plan.errors), marker="o", color=COLORS[4])
        axes[1].set_yscale("log")
        plain_ticks(axes[1].yaxis)
        axes[1].set_xlabel("tags")
        axes[1].set_ylabel("predicted RMS error [cm]")
