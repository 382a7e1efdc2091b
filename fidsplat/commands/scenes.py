"""Scenes as inputs of commands: scene files, splat files, stores; a camera for splats without one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.declarations import option
from fidsplat.commands.options import MemoryBudget, check_request
from fidsplat.commands.output import delayed_progress
from fidsplat.util.arguments import Names
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from fidsplat.cameras import Camera
    from fidsplat.experiments.bench.catalogue import BenchScene
    from fidsplat.formats import Progress
    from fidsplat.scenes import Scene
    from fidsplat.splats.cloud import SplatCloud
    from fidsplat.store.store import Store


SceneDevice = Annotated[
    str | None,
    option("D", "device; see `fidsplat devices` (default: the scene's, or FIDSPLAT_DEVICE, or auto)"),
]
SceneQuality = Annotated[
    str | None, option("Q", "preset, settings as key=value, or both (default: the scene's, or standard)")
]


@dataclass
class SceneInput:
    """A scene, its outputs and its quality."""

    source: Annotated[tyro.conf.Positional[str], option("SCENE.toml|FILE.ply|STORE.fss", "scene to render")]
    outputs: Names | None = None
    """output images; `fidsplat render --help` lists them (default: the scene's, or rgb)"""
    quality: SceneQuality = None

    def load(self) -> Scene:
        """The scene, with a progress bar when loading takes long. Raises InputError."""
        with delayed_progress() as progress:
            return load_source(self.source, self.quality, progress)


@dataclass
class RenderInput(SceneInput):
    """A scene and the device that renders it."""

    device: SceneDevice = None
    memory_budget: MemoryBudget = None

    def check(self) -> None:
        """Raise InputError for outputs or a quality that no scene can have."""
        check_request(self.outputs, self.quality)


def load_source(source: str, quality: str | None, progress: Progress) -> Scene:
    """A scene file, or a splat file or store with a camera that frames it.

    Raises:
        InputError: another kind of file; a scene without a camera.
    """
    import fidsplat as fs
    from fidsplat.formats.files import FORMATS
    from fidsplat.store.layout import SUFFIX

    suffix = Path(source).suffix.lower()
    if suffix == ".toml":
        scene = fs.Scene.load(source, quality, progress)
        if scene.camera is None:
            raise InputError(
                f"{source} must have a [camera] table; add one with width, height, fov_x_deg, position, "
                "look_at"
            )
        return scene
    if suffix == SUFFIX:
        store = fs.Store(source)
        return fs.Scene(stores=(store,), camera=framing_camera(store))
    if suffix in FORMATS:
        cloud = fs.load_splats(source, progress)
        return fs.Scene([cloud], camera=framing_camera(cloud))
    raise InputError(
        f"the source must be a scene file (.toml), a store ({SUFFIX}) or a splat file "
        f"({', '.join(FORMATS)}), got {source}"
    )


WIDTH, HEIGHT = 1280, 720
FOV_X = math.radians(60.0)
MARGIN = 1.1
REACH = 1.5
"""standard deviations of a splat that must be in view; with 3, faint tails would set the camera's distance"""
MANY = 10_000
"""captured scenes have strays far away: a cloud of this many is framed without the outermost 1 % of its
splats"""


def framing_camera(cloud: SplatCloud | Store) -> Camera:
    """A camera on the -z side, y down, with all splats in view; 1280 x 720 pixels, 60 degrees wide."""
    import numpy as np

    from fidsplat.cameras import Camera

    low, high = _extent(cloud)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-6)
    tangent = math.tan(FOV_X / 2)
    away = MARGIN * max(half[0] / tangent, half[1] / (tangent * HEIGHT / WIDTH)) + half[2]
    return Camera.look_at(WIDTH, HEIGHT, FOV_X, middle - [0, 0, away], middle, near=min(0.01, away / 100))


def _extent(cloud: SplatCloud | Store) -> tuple[np.ndarray, np.ndarray]:
    import numpy as np

    from fidsplat.store.store import Store

    if len(cloud) == 0:
        return -np.ones(3), np.ones(3)
    if isinstance(cloud, Store):  # bounds of its chunks, which are small compared with the scene
        return cloud.bounds(REACH)
    reach = cloud.reach(REACH)
    share = 0.5 if len(cloud) >= MANY else 0.0
    low = np.percentile(cloud.means - reach, share, axis=0)
    high = np.percentile(cloud.means + reach, 100 - share, axis=0)
    return low + cloud.origin, high + cloud.origin


UserScenes = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    option("SCENE.toml|FILE.ply", "your own scene instead of --scenes; repeat for several"),
]
Cameras = Annotated[
    str | None, option("FILE", "camera-to-world poses for --scene (docs/formats.md#trajectories)")
]


def load_user_scenes(
    files: tuple[str, ...], cameras: str | None, named: tuple[str, ...]
) -> dict[str, BenchScene]:
    """Scenes of --scene, rendered from the poses of --cameras; empty without --scene.

    Raises:
        InputError: --scenes in addition, --cameras without --scene, or an unreadable file.
    """
    from fidsplat.experiments.bench.catalogue import own_scenes
    from fidsplat.formats import load_trajectory

    if files and named:
        raise InputError("--scene and --scenes exclude each other; give one of them")
    if cameras is not None and not files:
        raise InputError("--cameras needs --scene FILE")
    path = None if cameras is None else load_trajectory(cameras)
    found: dict[str, BenchScene] = {}
    for name in files:
        with delayed_progress() as progress:
            found |= own_scenes(name, load_source(name, None, progress), path)
    return found
