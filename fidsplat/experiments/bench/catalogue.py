"""Benchmark scenes by name."""

from __future__ import annotations

import random
import string
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from fidsplat.cameras import Camera, Trajectory
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import Quality
from fidsplat.experiments.bench.ablation import ReducedScene, middle_camera, without_effects
from fidsplat.markers import marker
from fidsplat.render.flight import Flight
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.scenes.random_clouds import SCENES, load_scene, standard_camera
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.errors import InputError, unknown

TIMED = Quality(alpha_cutoff=1 / 255, transmittance_stop=1e-4, arithmetic="precise")
"""quality of the benchmark: cut-off and stop of other renderers, so that all do equal work"""
WALL_COLUMNS, WALL_ROWS, _WALL_CODES = 20, 10, 10


@dataclass(frozen=True)
class BenchScene:
    """Description and constructor of a benchmark scene."""

    about: str
    make: Callable[[], tuple[SplatCloud, Camera]]
    capture: Capture | None = None
    """timed capture; None: rgb of the camera at the quality `TIMED`"""
    without: Mapping[str, ReducedScene] = field(default_factory=dict)
    """effect of the capture -> the same frame without this effect, timed for comparison"""


def tag() -> tuple[SplatCloud, Camera]:
    """One AprilTag, a third of the image height: the fixed cost of a frame."""
    placed = PlacedMarker(marker("apriltag:36h11:5", size=0.16), rigid_matrix((0.0, 0.0, 0.55)))
    return Scene((), markers=(placed,)).cloud(), standard_camera(640, 480)


def tag_in_million() -> tuple[SplatCloud, Camera]:
    """An AprilTag of 0.4 m, 3 m from the camera, in front of the splats of r1m_1080p."""
    background, camera = load_scene("r1m_1080p")
    placed = PlacedMarker(marker("apriltag:36h11:5", size=0.4), rigid_matrix((0.0, 0.0, 3.0)))
    return Scene((background,), markers=(placed,)).cloud(), camera


def qr_wall() -> tuple[SplatCloud, Camera]:
    """200 QR codes in 20 columns and 10 rows on a wall that fills 1920 x 1080 pixels.

    Ten different codes of version 22 (1000 characters, level L) alternate.
    """
    letters = random.Random(0)
    texts = ("".join(letters.choices(string.ascii_letters, k=1000)) for _ in range(_WALL_CODES))
    codes = [marker(f"qr-v22-L:{text}", size=0.1) for text in texts]
    pitch = 0.115
    placed = []
    for number in range(WALL_COLUMNS * WALL_ROWS):
        row, column = divmod(number, WALL_COLUMNS)
        x, y = (column - (WALL_COLUMNS - 1) / 2) * pitch, (row - (WALL_ROWS - 1) / 2) * pitch
        placed.append(PlacedMarker(codes[number % _WALL_CODES], rigid_matrix((x, y, 2.0))))
    return Scene((), markers=tuple(placed)).cloud(), standard_camera(1920, 1080)


def _random(name: str) -> BenchScene:
    scene = SCENES[name]
    kind = "3D Gaussians" if scene.thick else "splats"
    about = f"{scene.count:,} random {kind}, {scene.width} x {scene.height}"
    return BenchScene(about, lambda: load_scene(name))


BENCH_SCENES: dict[str, BenchScene] = {
    "tag": BenchScene("an AprilTag, 640 x 480", tag),
    **{name: _random(name) for name in SCENES},
    "qr_wall": BenchScene("200 QR codes of version 22 on a wall, 1920 x 1080", qr_wall),
    "tag_in_million": BenchScene("an AprilTag before 1,000,000 random splats, 1920 x 1080", tag_in_million),
}
"""benchmark scenes in the order of listings"""

MOST_VIEWS = 8
"""maximum number of views of a user's scene, evenly distributed over the trajectory"""


def user_scenes(
    name: str, scene: Scene, path: Trajectory | None, most_views: int = MOST_VIEWS
) -> dict[str, BenchScene]:
    """Benchmark scenes of a user's scene by name, such as `room.toml@2`, with everything that it requests.

    Views are the scene's camera, or poses of a trajectory (camera to world), which also moves the shutter.

    Raises InputError for a scene without a camera.
    """
    camera = scene.camera
    if camera is None:
        raise InputError(f"{name} must have a [camera] table, got none; add one with size and lens")
    about = f"{len(scene.cloud()):,} splats, {camera.width} x {camera.height}"
    if path is None:
        captures = {name: scene.capture}
    else:
        poses = len(path)
        selected = sorted({round(k) for k in np.linspace(0, poses - 1, min(poses, most_views))})
        flight = Flight(scene, path, np.asarray(path.times)[selected], scene.capture)
        captures = {f"{name}@{k}": capture for k, capture in zip(selected, flight.captures, strict=True)}
    return {
        view: BenchScene(
            about if view == name else f"{about}, pose {view.rpartition('@')[2]}",
            lambda capture=capture: (scene.cloud(), middle_camera(capture)),
            capture,
            without_effects(scene, capture),
        )
        for view, capture in captures.items()
    }


DEFAULT_SCENES = ("tag", "r100k_720p", "r1m_1080p", "tag_in_million")
"""default scenes, which take about a minute on two cores"""


def scene_names(words: Iterable[str]) -> tuple[str, ...]:
    """Distinct scene names; `all` selects every scene, no word the default scenes.

    Raises:
        InputError: an unknown scene.
    """
    names: list[str] = []
    for word in words:
        names += BENCH_SCENES if word == "all" else (word,)
    for name in names:
        if name not in BENCH_SCENES:
            raise InputError(unknown("scene", name, ("all", *BENCH_SCENES)))
    return tuple(dict.fromkeys(names)) or DEFAULT_SCENES
