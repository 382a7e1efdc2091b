"""`fidsplat experiment plants`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from fidsplat.commands.output import Device, Json, console, late_progress, option, repeatable, tell
from fidsplat.commands.sweeps import BlenderEnvironment
from fidsplat.experiments.plants import PlantSettings


@repeatable
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
    settings: PlantSettings = field(default_factory=PlantSettings)
    environment: BlenderEnvironment = None
    device: Device = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments import plants
        from fidsplat.experiments.blender import default_environment

        environment = self.environment or default_environment()
        with late_progress(console(True)) as progress:
            made = list(
                plants.write_plants(self.settings, Path(self.out), environment, self.device, progress)
            )
        facts = {"plants": [{"file": str(file), "psnr": score} for file, score in made]}
        rows = [(str(file), "" if score is None else f"{score:.1f}") for file, score in made]
        return tell(self.json, facts, table=("plants", ("file", "PSNR of test views [dB]"), rows))
