"""Command `fidsplat plan-tags`: plan the positions of tags."""

from __future__ import annotations

from dataclasses import dataclass, field

import tyro

from fidsplat.commands.options import Device, Json, Overwrite, require_packages
from fidsplat.commands.output import delayed_progress, report
from fidsplat.experiments.plan_tags import PlanSettings
from fidsplat.util.files import refuse_existing, writable_folder


@dataclass
class PlanTags:
    """Plan the positions of tags for a camera that moves along a trajectory.

    Candidates are flat surfaces in view of the camera. Each has the Fisher information of its four corners at
    every pose that can read it: not occluded, modules of at least 2.5 pixels, incidence below 70 degrees,
    with the motion blur and the noise of the scene's shutter and sensor. Greedy selection and local search
    maximise the information about the trajectory. Existing tags of the scene contribute too.

    Writes DIR/scene.toml, the scene with the tags; plan.json; map.svg. Needs the extra `experiments`.

    Examples:
      fidsplat plan-tags scene.toml --trajectory flight.tum --count 10
      fidsplat plan-tags scene.toml --trajectory flight.tum --count 50 --target 0.01 --size 0.2 -o hall
    """

    source: tyro.conf.Positional[str]
    """SCENE.toml|FILE.ply|STORE.fss: scene"""
    trajectory: str
    """FILE: camera-to-world poses of the camera (docs/formats.md#trajectories)"""
    out: str = "fidsplat-plan"
    """DIR: folder"""
    settings: PlanSettings = field(default_factory=PlanSettings)
    device: Device = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.experiments.plan_tags import plan_tags, write_plan
        from fidsplat.scenes.sources import load_source

        require_packages("the map", ("matplotlib",))
        path = fs.load_trajectory(self.trajectory)
        folder = writable_folder(self.out)
        refuse_existing(folder / "scene.toml", self.overwrite)
        with delayed_progress() as progress:
            scene = load_source(self.source)
            renderer = fs.Renderer(self.device or scene.device)
            plan = plan_tags(scene, path, self.settings, renderer, progress)
        files = write_plan(plan, folder, self.settings.size)
        facts = plan.facts()
        rows = [
            (
                tag["spec"],
                " ".join(f"{v:.3f}" for v in tag["position"]),
                tag["poses"],
                f"{100 * tag['error_m']:.3g}",
            )
            for tag in facts["tags"]
        ]
        without, with_tags = 100 * facts["error_without_m"], 100 * facts["error_m"]
        lines = [
            f"{len(rows)} of {facts['candidates']} candidates; predicted RMS error of positions "
            f"{without:.3g} cm without them, {with_tags:.3g} cm with them",
        ]
        if facts["bound"] is not None:
            fraction = 100 * facts["objective"] / max(facts["bound"], 1e-9)
            lines.append(
                f"information {facts['objective']:.1f} nats, at least {fraction:.0f} % of the optimum"
            )
        if self.settings.target is None and len(rows) < self.settings.count:
            lines.append(
                f"fewer than {self.settings.count}: other candidates overlap these, or add no information"
            )
        lines += map(str, files)
        head = ("tag", "position [m]", "poses", "predicted error [cm]")
        return report(
            self.json, facts | {"files": [str(file) for file in files]}, *lines, table=("", head, rows)
        )
