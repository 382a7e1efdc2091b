"""Command `fidsplat view`: show a scene in a browser."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from fidsplat.commands.options import MemoryBudget
from fidsplat.commands.output import console, delayed_progress, print_lines
from fidsplat.commands.scenes import SceneDevice, SceneQuality
from fidsplat.scenes.sources import OWN_POSE, StartPose
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, path_of, read_text
from fidsplat.viewer.settings import PageSettings

if TYPE_CHECKING:
    from fidsplat.formats import Progress
    from fidsplat.scenes import Scene

CHECKPOINT = ".training.npz"
"""ending of a checkpoint's name"""


@dataclass
class View:
    """Show a scene in a browser, rendered by fidsplat from any viewpoint.

    Renders small images while the view moves, then one exact image; no GPU is needed. Drag to rotate,
    right-drag to pan, wheel to approach; click a pixel to read its outputs. Controls set device, quality,
    lens, fog and sensor. A gizmo moves a marker or a splat file and writes its pose into the scene file,
    which is reloaded after edits. Keyframes become a trajectory for `fidsplat fly`. Needs pip install
    'fidsplat[viewer]'.

    Only this machine can open the page. From elsewhere: ssh -L 8080:localhost:8080 THAT_MACHINE

    A RUN is a folder of `fidsplat fly`, whose poses become keyframes, or a folder or checkpoint of `fidsplat
    train`, whose splats are updated during the training.

    Examples:
      fidsplat view                                                      the demo's scene
      fidsplat view scene.toml
      fidsplat view room.ply --port 9000 --device opencl:nvidia
      fidsplat view map.ply --up 0 0 1 --position 0 -5 2 --look-at 0 0 1
      fidsplat view fidsplat-flight
      fidsplat view yard.training.npz --trajectory yard/sparse/0       a training, and its cameras
    """

    source: tyro.conf.Positional[str | None] = None
    """SCENE.toml|FILE.ply|STORE.fss|RUN: scene to show (default: the demo's scene)"""
    trajectory: str | None = None
    """FILE: poses to show as keyframes (docs/formats.md#trajectories), e.g. a flight's trajectory.tum"""
    pose: StartPose = field(default_factory=StartPose)
    page: PageSettings = field(default_factory=PageSettings)
    device: SceneDevice = None
    quality: SceneQuality = None
    memory_budget: MemoryBudget = None

    def run(self) -> int:
        from fidsplat.formats import load_trajectory
        from fidsplat.viewer.server import Viewer, check_port

        check_port(self.page.host, self.page.port)
        target = self._target()
        path = None if target.trajectory is None else load_trajectory(target.trajectory)
        where = console(True)
        with delayed_progress() as progress:
            scene = target.scene(self.quality, progress, self.pose)
        file = Path(target.source) if target.source.lower().endswith(".toml") else None
        reload = None if target.training is None else target.training.reload
        with where.status("compiling"):
            viewer = Viewer(
                scene,
                file,
                self.device,
                self.memory_budget,
                self.page,
                keyframes=path,
                reload=reload,
                quality=self.quality,
            )
        print_lines(console(False), f"{viewer.address} shows {self.source or 'the demo'}; Ctrl-C ends it")
        try:
            while True:
                interrupts.sleep(1.0)
        finally:
            viewer.close()

    def _target(self) -> Target:
        from fidsplat.store.layout import SUFFIX

        if self.source is None:
            return Target("", self.trajectory)
        folder = path_of(self.source)
        if checkpoint := find_checkpoint(folder):
            return Target(self.source, self.trajectory, Training(checkpoint, self.quality))
        if not folder.is_dir() or folder.suffix.lower() == SUFFIX:
            return Target(self.source, self.trajectory)
        source, poses = flight_source(folder)
        return Target(source, self.trajectory or poses)


@dataclass(frozen=True)
class Target:
    """Scene, flight or training run to show."""

    source: str
    """scene or splat file; empty for the demo's scene"""
    trajectory: str | None
    """trajectory file whose poses are shown as keyframes"""
    training: Training | None = None

    def scene(self, quality: str | None, progress: Progress, pose: StartPose = OWN_POSE) -> Scene:
        """Load the scene; quality and pose replace the file's."""
        from fidsplat.scenes.sources import load_source
        from fidsplat.worlds.yard import demo_scene

        changes = {} if quality is None else {"quality": quality}
        if self.source and self.training is None:
            return replace(load_source(self.source, quality, progress, pose), **changes)
        scene = replace(demo_scene(), **changes) if self.training is None else self.training.scene
        assert scene.camera is not None
        return replace(scene, camera=pose.applied(scene.camera))


def find_checkpoint(source: Path) -> Path | None:
    """Checkpoint in the folder of a training, or the source if it is a checkpoint; None otherwise.

    Raises:
        InputError: the folder contains several checkpoints.
    """
    if source.name.endswith(CHECKPOINT):
        return source
    files = sorted(source.glob(f"*{CHECKPOINT}")) if source.is_dir() else []
    if len(files) > 1:
        names = ", ".join(file.name for file in files)
        raise InputError(f"{source} must contain one training run, got several; name one of {names} there")
    return files[0] if files else None


def flight_source(folder: Path) -> tuple[str, str]:
    """Scene file and pose file of a flight's folder.

    Raises:
        InputError: the folder is not of `fidsplat fly`, or its scene no longer exists.
    """
    from fidsplat.render.flight import POSES, RECORD

    poses = folder / POSES
    try:
        source = from_json(read_text(folder / RECORD))["source"]
        file = folder / source
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"a folder to view must contain *{CHECKPOINT} of `fidsplat train` or a {RECORD} of `fidsplat "
            f"fly` that names its scene, got {folder}; to view a scene, give its file"
        ) from None
    if not file.exists():
        raise InputError(
            f"the scene of the flight {folder} must exist, got {source}, which is missing; give its new "
            f"path, with --trajectory {poses}"
        )
    return str(file), str(poses)


class Training:
    """Splats of a training, read from its checkpoint, which changes during the training."""

    def __init__(self, file: Path, quality: str | None = None) -> None:
        self.file, self._quality = file, quality
        self._loaded = self._stamp()
        self.scene = self._load()

    def reload(self) -> Scene | None:
        """Reload the splats with the same camera if the checkpoint has changed; None otherwise."""
        stamp = self._stamp()
        if stamp is None or stamp == self._loaded:
            return None
        self._loaded = stamp
        self.scene = replace(self._load(), camera=self.scene.camera)
        return self.scene

    def _load(self) -> Scene:
        from fidsplat.scenes import Scene
        from fidsplat.scenes.sources import framing_camera
        from fidsplat.train import splats_of

        cloud, background = splats_of(self.file)
        return Scene((cloud,), camera=framing_camera(cloud), background=background, quality=self._quality)

    def _stamp(self) -> tuple[int, int] | None:
        try:
            status = self.file.stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size
