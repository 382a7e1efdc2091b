"""`fidsplat experiment plants`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fidsplat.commands.output import Device, Json, console, late_progress, option, tell
from fidsplat.commands.sweeps import Names, asked


@dataclass
class Plants:
    """Make plants in Blender: grown as meshes, drawn from many poses, and trained by our trainer.

    DIR/KIND-NUMBER.ply are for `fidsplat greenhouse --plants-from DIR`; the pictures stay beside them as data
    sets. What is there stays, and a run that was stopped goes on. Blender comes by `fidsplat experiment
    blender --install`, into an environment of its own; with --iterations 0 nothing needs it, and plants are
    disks on the meshes.

    Examples:
      fidsplat experiment blender --install
      fidsplat experiment plants -o plants && fidsplat greenhouse --plants-from plants
      fidsplat experiment plants -o plants --kind tomato --each 10
      fidsplat experiment plants -o sampled --iterations 0
    """

    out: Annotated[str, option("DIR", "folder (default: fidsplat-plants)", "-o")] = "fidsplat-plants"
    kind: Annotated[Names, option("NAME", "tomato, cucumber or lettuce, once for each (default: all)")] = ()
    each: Annotated[int, option("N", "plants of a kind (default: 2)")] = 2
    views: Annotated[int, option("N", "pictures of each to train on (default: 24)")] = 24
    samples: Annotated[int, option("N", "of Blender for each pixel (default: 16)")] = 16
    splats: Annotated[int, option("N", "of each (default: 5000)")] = 5000
    iterations: Annotated[int, option("N", "of training (default: 1500)")] = 1500
    seed: Annotated[int, option("N", "of the plants (default: 0)")] = 0
    environment: Annotated[
        Path | None,
        option("DIR", "Blender's virtual environment (default: fidsplat/blender in the user's cache)"),
    ] = None
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments import plants
        from fidsplat.experiments.blender import default_environment

        wanted = asked(plants.Plants, self, kinds=self.kind or None)
        environment = self.environment or default_environment()
        with late_progress(console(True)) as progress:
            made = list(plants.write_plants(wanted, Path(self.out), environment, self.device, progress))
        facts = {"plants": [{"file": str(file), "psnr": score} for file, score in made]}
        rows = [(str(file), "" if score is None else f"{score:.1f}") for file, score in made]
        return tell(self.json, facts, table=("plants", ("file", "PSNR of test views [dB]"), rows))
