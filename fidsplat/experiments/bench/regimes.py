"""Scenes of `fidsplat bench --suite`, by the regime that dominates the cost of a frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.cameras.pinhole import look_at_matrix
from fidsplat.capture.quality import MarkerQuality
from fidsplat.experiments.bench.catalogue import qr_wall
from fidsplat.formats import load_splats
from fidsplat.formats.collect import collect
from fidsplat.markers import marker
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.captured import captured_scenes, fetch_scene
from fidsplat.scenes.random_clouds import SCENES, load_scene, log_uniform, random_cloud, standard_camera
from fidsplat.splats.arrays import all_scales
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError, unknown
from fidsplat.worlds.city import City, flight

DISKS, ELLIPSOIDS, BOXES = "disks", "ellipsoids", "boxes"
"""kinds of splats of a scene; each renderer declares the kinds that it supports"""
ARRAYS = ("means", "quats", "scales", "opacities", "colors", "boxes", "coplanar_groups")
_COUNT, _SCALE = 100_000, 0.03
"""number of splats of synthetic scenes, and their median scale in metres"""


@dataclass(frozen=True, eq=False)
class Views:
    """Splats with plain colours, and the poses from which they are rendered."""

    cloud: SplatCloud
    camera: Camera
    poses: np.ndarray
    """(v, 4, 4) world to camera"""
    scene: Scene | None = None
    """scene with markers, whose poses are detected in the image"""

    @property
    def kind(self) -> str:
        if self.cloud.boxes is not None and np.any(self.cloud.boxes):
            return BOXES
        return DISKS if self.cloud.thickness is None else ELLIPSOIDS

    def save(self, file: Path) -> Path:
        """Write an npz file for adapters: `ARRAYS`, poses, matrix (3, 3), size (2,) and near.

        The array `scales` is (n, 2) for disks and boxes, (n, 3) for ellipsoids. The arrays `boxes` and
        `coplanar_groups` are optional.
        """
        cloud, camera = self.cloud, self.camera
        arrays = {name: getattr(cloud, name) for name in ARRAYS}
        arrays["means"] = cloud.means + cloud.origin.astype(np.float32)
        arrays["scales"] = all_scales(cloud)
        present = {name: array for name, array in arrays.items() if array is not None}
        size = (camera.width, camera.height)
        np.savez(file, poses=self.poses, matrix=camera.matrix, size=size, near=camera.near, **present)
        return file


@dataclass(frozen=True)
class SuiteScene:
    """A scene of `fidsplat bench --suite`, with its cameras."""

    regime: str
    about: str
    make: Callable[[], Views]
    quick: bool = False
    """whether quick runs measure it"""
    large: bool = False
    """whether it is skipped on processors"""
    batch: bool = False
    """whether all views are one submission; otherwise each submission is the next view"""
    x: float | None = None
    """abscissa in a series of the regime `scaling`"""
    licence: str = "generated from a seed"


def _single(cloud: SplatCloud, camera: Camera, scene: Scene | None = None) -> Views:
    return Views(cloud, camera, camera.world_to_camera[None], scene)


def _changed(cloud: SplatCloud, **arrays: np.ndarray) -> SplatCloud:
    """The cloud with some arrays replaced."""
    columns = {name: getattr(cloud, name) for name in ("means", "quats", "opacities", "colors")}
    return SplatCloud(**{**columns, "scales": all_scales(cloud), **arrays})


def huge(thick: bool) -> Views:
    """1 % of the splats are 0.5 to 3 m wide: these cover most tiles."""
    cloud, generator = random_cloud(_COUNT, _SCALE, thick=thick), np.random.default_rng(1)
    factor = np.ones((_COUNT, 1))
    factor[:: _COUNT // 1000] = log_uniform(generator, 15.0, 100.0, (1000, 1))
    return _single(
        _changed(cloud, scales=(all_scales(cloud) * factor).astype(np.float32)), standard_camera(1280, 720)
    )


def clusters(thick: bool) -> Views:
    """All splats in 12 dense clusters: few tiles have most of the work."""
    cloud, generator = random_cloud(_COUNT, _SCALE, thick=thick), np.random.default_rng(2)
    centers = generator.uniform((-3.0, -1.5, 6.0), (3.0, 1.5, 10.0), (12, 3))
    near = generator.normal(0.0, 0.12, (_COUNT, 3))
    means = centers[generator.integers(0, 12, _COUNT)] + near
    return _single(_changed(cloud, means=means.astype(np.float32)), standard_camera(1280, 720))


def needles(thick: bool) -> Views:
    """Splats 40 times as long as wide: bounding boxes are mostly empty."""
    cloud = random_cloud(_COUNT, _SCALE, thick=thick)
    factor = np.array([6.0, 0.15, 0.15][: 3 if thick else 2])
    return _single(
        _changed(cloud, scales=(all_scales(cloud) * factor).astype(np.float32)), standard_camera(1280, 720)
    )


def haze(thick: bool) -> Views:
    """Faint splats, most below an alpha of 1/50: hundreds of layers per pixel, without occlusion."""
    cloud, generator = random_cloud(_COUNT, 0.06, thick=thick), np.random.default_rng(3)
    opacities = log_uniform(generator, 1e-3, 2e-2, _COUNT).astype(np.float32)
    return _single(_changed(cloud, opacities=opacities), standard_camera(1280, 720))


def street(splats: int, frames: int) -> Views:
    """Flight through a generated city, with most splats outside of each view."""
    city = City(splats)
    camera, motion = flight(city)
    arrays, _ = collect(city.source.rows)
    times = np.linspace(motion.times[0], motion.times[-1], frames)
    return Views(SplatCloud(**arrays), camera, np.stack([motion(float(time)) for time in times]))


def tags(boxes: bool) -> Views:
    """24 AprilTags at tilts up to 60 degrees, whose poses are detected.

    boxes: exact rectangles, which other renderers lack; otherwise Gaussians.
    """
    quality, placed = MarkerQuality("exact" if boxes else "fitted"), []
    for number in range(24):
        row, column = divmod(number, 6)
        tilt, azimuth = math.radians(60.0 * row / 3), 2 * math.pi * column / 6
        axis = np.array([math.cos(azimuth), math.sin(azimuth), 0.0]) * math.sin(tilt / 2)
        place = ((column - 2.5) * 0.3, (row - 1.5) * 0.3, 1.6 + 0.1 * (number % 3))
        pose = rigid_matrix(place, (math.cos(tilt / 2), *axis))
        placed.append(PlacedMarker(marker(f"apriltag:36h11:{number}", size=0.16, quality=quality), pose))
    camera = standard_camera(1280, 720)
    scene = Scene((), markers=tuple(placed), camera=camera)
    return _single(scene.cloud(), camera, scene)


def captured(name: str, width: int, height: int, frames: int = 1) -> Views:
    """Captured scene with plain colours, from one view or an orbit of 360 degrees."""
    cloud = load_splats(fetch_scene(name))
    means = cloud.means + cloud.origin.astype(np.float32)
    colors = cloud.colors if cloud.sh is None else cloud.sh[:, 0] * C0 + 0.5
    assert colors is not None
    cloud = _changed(cloud, means=means, colors=np.maximum(colors, 0))
    middle = np.median(means, 0)
    radius = 1.2 * np.percentile(np.linalg.norm(means - middle, axis=1), 95)
    angles = 0.68 + np.linspace(0, 2 * math.pi, frames, endpoint=False)
    eyes = [middle + radius * np.array([0.95 * math.sin(a), -0.3, -0.95 * math.cos(a)]) for a in angles]
    camera = Camera.look_at(width, height, 1.0, eyes[0], middle)
    return Views(cloud, camera, np.stack([look_at_matrix(eye, middle) for eye in eyes]))


def agents(views: int) -> Views:
    """Small images of 10,000 splats from views on an arc, like cameras of simulated robots."""
    cloud, target = random_cloud(10_000, _SCALE), np.array([0.0, 0.0, 6.0])
    angles = np.linspace(-math.pi / 4, math.pi / 4, views)
    eyes = [target - 6.0 * np.array([math.sin(a), 0.0, math.cos(a)]) for a in angles]
    return Views(cloud, standard_camera(128, 128), np.stack([look_at_matrix(eye, target) for eye in eyes]))


def _both(name: str, regime: str, make: Callable[[bool], Views], quick: bool = False) -> dict:
    """Two versions of a scene, with disks and with 3D Gaussians."""
    about = (make.__doc__ or "").partition(":")[0].rstrip(".")
    return {
        name: SuiteScene(regime, about, partial(make, False), quick),
        f"{name}_3d": SuiteScene(regime, f"{about}; 3D Gaussians", partial(make, True)),
    }


def _uniform(name: str, quick: bool = False, large: bool = False) -> SuiteScene:
    size = SCENES[name]
    about = f"{size.count:,} random {'3D Gaussians' if size.thick else 'disks'}"
    return SuiteScene("uniform", about, lambda: _single(*load_scene(name)), quick, large)


def _captured(name: str, width: int, height: int, frames: int = 1, **how: Any) -> SuiteScene:
    capture = captured_scenes()[name]
    about = f"{capture.title}, {capture.splats:,} 3D Gaussians" + (", an orbit" if frames > 1 else "")
    make = partial(captured, name, width, height, frames)
    return SuiteScene("captured", about, make, licence=capture.credit, **how)


def _agents(views: int, **how: Any) -> SuiteScene:
    about = f"{views} views of 10,000 disks in one submission"
    return SuiteScene("batches", about, partial(agents, views), batch=True, **how)


def scaled(count: int, scale: float, width: int, height: int) -> Views:
    """Random disks for one point of a series of the regime `scaling`."""
    return _single(random_cloud(count, scale), standard_camera(width, height))


def _series() -> dict[str, SuiteScene]:
    """Scenes of the regime `scaling` by name, SERIES@X.

    The series vary the number of splats at a constant covered area, the number of pixels, and the size of
    splats (overdraw).
    """
    million = 1_000_000
    scenes: dict[str, SuiteScene] = {}
    for count in (10_000, 30_000, 100_000, 300_000, million, 3 * million, 10 * million):
        make = partial(scaled, count, 0.012 * math.sqrt(million / count), 1280, 720)
        scenes[f"splats@{count}"] = SuiteScene(
            "scaling", f"{count:,} disks of the same covered area", make, large=count > million, x=count
        )
    for height in (180, 360, 720, 1440, 2160):
        pixels = height * height * 16 // 9
        make = partial(scaled, _COUNT, _SCALE, height * 16 // 9, height)
        about = f"{_COUNT:,} disks, {height} rows"
        scenes[f"pixels@{pixels}"] = SuiteScene("scaling", about, make, large=height > 1440, x=pixels)
    for factor in (0.5, 1.0, 2.0, 4.0, 8.0):
        make = partial(scaled, 30_000, _SCALE * factor, 1280, 720)
        about = f"30,000 disks, {factor:g} times the size"
        scenes[f"size@{factor:g}"] = SuiteScene("scaling", about, make, large=factor > 4, x=factor)
    return scenes


SUITE: dict[str, SuiteScene] = {
    "r100k_720p": _uniform("r100k_720p", quick=True),
    "r1m_1080p": _uniform("r1m_1080p"),
    "r5m_1080p": _uniform("r5m_1080p", large=True),
    "r20m_4k": _uniform("r20m_4k", large=True),
    "r100k_720p_3d": _uniform("r100k_720p_3d"),
    "r1m_1080p_3d": _uniform("r1m_1080p_3d", large=True),
    **_both("huge", "skewed", huge),
    **_both("clusters", "skewed", clusters, quick=True),
    **_both("needles", "skewed", needles),
    **_both("haze", "haze", haze, quick=True),
    "street": SuiteScene(
        "street",
        "a flight of 120 frames through a city of 500,000 disks",
        partial(street, 500_000, 120),
        quick=True,
    ),
    "street_5m": SuiteScene(
        "street",
        "a flight of 120 frames through a city of 5,000,000 disks",
        partial(street, 5_000_000, 120),
        large=True,
    ),
    "tags": SuiteScene("markers", "24 AprilTags of Gaussians", partial(tags, False), quick=True),
    "tags_exact": SuiteScene("markers", "24 AprilTags of exact rectangles", partial(tags, True)),
    "qr_wall": SuiteScene(
        "markers", "200 QR codes of exact rectangles", lambda: _single(*qr_wall()), large=True
    ),
    "biker_720p": _captured("biker", 1280, 720, quick=True),
    "biker_1080p": _captured("biker", 1920, 1080),
    "biker_4k": _captured("biker", 3840, 2160, large=True),
    "biker_orbit": _captured("biker", 1280, 720, 120),
    "guitar_1080p": _captured("guitar", 1920, 1080),
    "playbot_1080p": _captured("playbot", 1920, 1080),
    "agents_64": _agents(64, quick=True),
    "agents_1024": _agents(1024, large=True),
    "agents_4096": _agents(4096, large=True),
    **_series(),
}
"""scenes by name"""
REGIMES = tuple(dict.fromkeys(scene.regime for scene in SUITE.values()))


def suite_scenes(words: Iterable[str], quick: bool, large: bool) -> dict[str, SuiteScene]:
    """Scenes by name or regime; by default all that suit the machine. A word that is both a scene and a
    regime (`haze`) selects the scene.

    Args:
        quick: only scenes of quick runs. large: also scenes for GPUs.

    Raises:
        InputError: an unknown name.
    """
    words = tuple(words)
    for word in words:
        if word not in SUITE and word not in REGIMES:
            raise InputError(unknown("scene of the suite", word, (*REGIMES, *SUITE)))
    if words:
        regimes = set(words) - set(SUITE)
        return {
            name: definition
            for name, definition in SUITE.items()
            if name in words or definition.regime in regimes
        }
    return {
        name: definition
        for name, definition in SUITE.items()
        if (definition.quick or not quick) and (large or not definition.large)
    }
