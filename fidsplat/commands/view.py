"""`fidsplat view`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

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
from fidsplat.errors import InputError


@dataclass
class View:
    """Show a scene in a browser: our own pictures, from wherever one looks.

    Small pictures while the view moves, an exact one at rest, none while nothing changes; no GPU is needed,
    here or in the browser's machine. Drag to turn, right-drag to shift, wheel to come near; click to ask
    what is there. Controls for device, quality, lens, fog and sensor; a gizmo moves a marker and writes its
    pose into the scene file, which is read again when it is edited meanwhile; keyframes become a trajectory
    for `fidsplat fly`. Needs pip install 'fidsplat[viewer]'.

    Only this machine reaches the page. From elsewhere: ssh -L 8080:localhost:8080 THAT_MACHINE

    Examples:
      fidsplat view fidsplat-demo/scene.toml
      fidsplat view room.ply --port 9000 --device opencl:nvidia
    """

    source: Annotated[tyro.conf.Positional[str], option("SCENE.toml|FILE.ply|STORE.fss", "what to show")]
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
        path = None if self.trajectory is None else load_trajectory(self.trajectory)
        where = console(True)
        with late_progress(where) as progress:
            scene = load_source(self.source, self.quality, progress)
        file = Path(self.source) if self.source.lower().endswith(".toml") else None
        with where.status("compiling"):
            viewer = Viewer(scene, file, self.device, budget, self.host, self.port, self.rate, path)
        say(console(False), f"{viewer.address} shows {self.source}; Ctrl-C ends it")
        try:
            while True:
                time.sleep(1.0)
        finally:
            viewer.close()
