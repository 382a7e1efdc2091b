"""Scenes as inputs of commands, with their options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.options import MemoryBudget, check_request
from fidsplat.commands.output import delayed_progress
from fidsplat.scenes.sources import OWN_POSE, StartPose
from fidsplat.util.arguments import Names
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.experiments.bench.catalogue import BenchScene
    from fidsplat.scenes import Scene


SceneDevice = Annotated[
    str | None,
    "D: device; see `fidsplat devices` (default: the scene's, or FIDSPLAT_DEVICE, or auto)",
]
SceneQuality = Annotated[
    str | None, "Q: preset, settings as key=value, or both (default: the scene's, or standard)"
]


@dataclass
class SceneInput:
    """A scene, its outputs and its quality."""

    source: tyro.conf.Positional[str]
    """SCENE.toml|FILE.ply|STORE.fss: scene to render"""
    outputs: Names | None = None
    """output images; `fidsplat render --help` lists them (default: the scene's, or rgb)"""
    quality: SceneQuality = None

    def load(self, pose: StartPose = OWN_POSE, size: tuple[int, int] | None = None) -> Scene:
        """Load the scene, with a progress bar. Raises InputError.

        pose, size: of the camera, instead of the scene's.
        """
        from fidsplat.scenes.sources import load_source

        with delayed_progress() as progress:
            return load_source(self.source, self.quality, progress, pose, size)


@dataclass
class RenderInput(SceneInput):
    """A scene, and the device that renders it."""

    device: SceneDevice = None
    memory_budget: MemoryBudget = None

    def check(self) -> None:
        """Raise InputError for outputs or a quality that no scene can have."""
        check_request(self.outputs, self.quality)


def load_scene_file(path: str, purpose: str) -> Scene:
    """Load a scene file that has a camera, with a progress bar. purpose: use of the camera, for the error."""
    import fidsplat as fs

    with delayed_progress() as progress:
        scene = fs.Scene.load(path, progress=progress)
    if scene.camera is None:
        raise InputError(f"{path} must have a [camera] table {purpose}, got none; add one")
    return scene


Size = Annotated[
    tuple[int, int] | None,
    "WIDTH HEIGHT: pixels of the image (default: the scene's; for a splat file 1280 720)",
]
UserScenes = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    "SCENE.toml|FILE.ply: your own scene instead of --scenes; repeat for several",
]
Cameras = Annotated[str | None, "FILE: camera-to-world poses for --scene (docs/formats.md#trajectories)"]


def load_user_scenes(
    files: tuple[str, ...], cameras: str | None, named: tuple[str, ...], most_views: int | None = None
) -> dict[str, BenchScene]:
    """Benchmark scenes of the --scene files, with a view for each pose of --cameras, by default at most 8
    views of a scene, evenly distributed. Empty without --scene.

    Raises:
        InputError: --scene and --scenes, --cameras without --scene, or an unreadable file.
    """
    from fidsplat.experiments.bench.catalogue import MOST_VIEWS, user_scenes
    from fidsplat.formats import load_trajectory
    from fidsplat.scenes.sources import load_source

    if files and named:
        raise InputError("--scene and --scenes must not be given together, got both; omit one")
    if cameras is not None and not files:
        raise InputError(
            "--cameras must be given together with --scene FILE, got no --scene; add it, or omit --cameras"
        )
    path = None if cameras is None else load_trajectory(cameras)
    scenes: dict[str, BenchScene] = {}
    for name in files:
        with delayed_progress() as progress:
            scenes |= user_scenes(name, load_source(name, None, progress), path, most_views or MOST_VIEWS)
    return scenes
