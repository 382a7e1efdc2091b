"""`fidsplat view`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import (
    MemoryBudget,
    SceneDevice,
    SceneQuality,
    bytes_of,
    console,
    late_progress,
    option,
    say,
)
from fidsplat.commands.render import load_source
from fidsplat.commands.runs import TrainingRun, checkpoint_of, flown
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

if TYPE_CHECKING:
    from fidsplat.formats import Progress
    from fidsplat.scenes import Scene


@dataclass
class View:
    """Show a scene in a browser: our own pictures, from wherever one looks.

    Small pictures while the view moves, an exact one at rest, none while nothing changes; no GPU is needed,
    here or in the browser's machine. Drag to turn, right-drag to shift, wheel to come near; click to ask
    what is there. Controls for device, quality, lens, fog and sensor; a gizmo moves a marker or a splat file
    and writes its pose into the scene file, which is read again when it is edited meanwhile; keyframes become
    a trajectory for `fidsplat fly`. Needs pip install 'fidsplat[viewer]'.

    Only this machine reaches the page. From elsewhere: ssh -L 8080:localhost:8080 THAT_MACHINE

    A RUN is a folder of `fidsplat fly`, whose poses stand there as keyframes, or of `fidsplat train`, or its
    checkpoint, whose splats are shown as they grow.

    Examples:
      fidsplat view                                                      the demo's scene
      fidsplat view scene.toml
      fidsplat view room.ply --port 9000 --device opencl:nvidia
      fidsplat view fidsplat-flight
      fidsplat view yard.training.npz --trajectory yard/sparse/0       a training, and its cameras
    """

    source: Annotated[
        tyro.conf.Positional[str | None],
        option("SCENE.toml|FILE.ply|STORE.fss|RUN", "what to show (default: the demo's scene)"),
    ] = None
    trajectory: Annotated[
        str | None,
        option(
            "FILE", "poses shown as keyframes (docs/trajectories.md), e.g. DIR/trajectory.tum of a flight"
        ),
    ] = None
    port: Annotated[int, option("N", "of the page (default: 8080)")] = 8080
    host: Annotated[
        str, option("ADDRESS", "to listen on; 0.0.0.0 lets the whole network in (default: 127.0.0.1)")
    ] = "127.0.0.1"
    device: SceneDevice = None
    quality: SceneQuality = None
    rate: Annotated[float, option("HZ", "pictures a second to aim at while moving (default: 30)")] = 30.0
    memory_budget: MemoryBudget = None

    def run(self) -> int:
        from fidsplat.formats import load_trajectory
        from fidsplat.viewer.server import Viewer, check_port

        budget = bytes_of("--memory-budget", self.memory_budget)
        if not 0 < self.rate <= 1000:
            raise InputError(f"--rate is {self.rate:g}; give pictures a second, up to 1000")
        check_port(self.host, self.port)
        shown = self._shown()
        path = None if shown.trajectory is None else load_trajectory(shown.trajectory)
        where = console(True)
        with late_progress(where) as progress:
            scene = shown.scene(self.quality, progress)
        file = Path(shown.source) if shown.source.lower().endswith(".toml") else None
        again = None if shown.run is None else shown.run.again
        with where.status("compiling"):
            words = (self.device, budget, self.host, self.port, self.rate, path, again)
            viewer = Viewer(scene, file, *words, quality=self.quality)
        say(console(False), f"{viewer.address} shows {self.source or 'the demo'}; Ctrl-C ends it")
        try:
            while True:
                interrupts.sleep(1.0)
        finally:
            viewer.close()

    def _shown(self) -> Shown:
        from fidsplat.store.layout import SUFFIX

        if self.source is None:
            return Shown("", self.trajectory)
        folder = path_of(self.source)
        if checkpoint := checkpoint_of(folder):
            return Shown(self.source, self.trajectory, TrainingRun(checkpoint, self.quality))
        if not folder.is_dir() or folder.suffix.lower() == SUFFIX:
            return Shown(self.source, self.trajectory)
        source, poses = flown(folder)
        return Shown(source, self.trajectory or poses)


@dataclass(frozen=True)
class Shown:
    """What is to be shown."""

    source: str
    """file; empty for the demo"""
    trajectory: str | None
    """file of the poses that stand there as keyframes"""
    run: TrainingRun | None = None
    """that is followed"""

    def scene(self, quality: str | None, progress: Progress) -> Scene:
        """The scene; quality: instead of its own."""
        if self.run is not None:
            return self.run.scene
        if self.source:
            return replace(load_source(self.source, quality, progress), **_of(quality))
        from fidsplat.experiments.demo_scene import demo_scene

        return replace(demo_scene(), **_of(quality))


def _of(quality: str | None) -> dict[str, str]:
    return {} if quality is None else {"quality": quality}
