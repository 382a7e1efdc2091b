"""Command `fidsplat scan`: scan a scene with a simulated LiDAR."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import tyro

from fidsplat.commands.options import Json, Overwrite
from fidsplat.commands.output import console, delayed_progress, report
from fidsplat.commands.scenes import SceneDevice
from fidsplat.scenes.sources import StartPose
from fidsplat.util.files import new_file


@dataclass
class Scan:
    """Scan a scene with a simulated LiDAR and write its points.

    The sensor is at the scene's camera, or at --position and --look-at: x forward, y left, z up. The file
    has one point per return: x, y, z in metres, intensity, ring, time in seconds, and echo.

    Sensors: {presets}.

    Examples:
      fidsplat scan scene.toml --lidar os1-64
      fidsplat scan greenhouse.toml --lidar vlp-16 --position 0 0.75 0.5 --look-at 5 0.75 0.5 -o row.ply
      fidsplat scan scene.toml --lidar livox-mid-40 --frame world --labels -o scan.npy
    """

    source: tyro.conf.Positional[str]
    """SCENE.toml|FILE.ply|STORE.fss: scene to scan"""
    lidar: str = "os1-64"
    """NAME: sensor"""
    out: str = "scan.pcd"
    """FILE.pcd|FILE.ply|FILE.npy: points"""
    frame: str = "lidar"
    """lidar|world: frame of the points"""
    labels: bool = False
    """also write the label of the splats"""
    ideal: bool = False
    """no noise, no drop-outs, detection up to the maximum range"""
    seed: int = 0
    """N: seed of noise and detection"""
    pose: StartPose = field(default_factory=StartPose)
    device: SceneDevice = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.formats.points import check_points_file
        from fidsplat.render.scan import check_frame
        from fidsplat.scenes.sources import load_source

        lidar = fs.Lidar.preset(self.lidar, seed=self.seed)
        if self.ideal:
            lidar = replace(lidar, noise=0.0, noise_growth=0.0, detection_range=np.inf, dropouts=0.0)
        check_frame(self.frame)
        check_points_file(self.out)
        new_file(self.out, self.overwrite)
        with delayed_progress() as progress:
            scene = load_source(self.source, None, progress, self.pose)
        with console(self.json).status("scanning"):
            renderer = fs.Renderer(self.device or scene.device)
            scan = fs.scan(scene, lidar, renderer=renderer, label=self.labels)
        scan.save(self.out, self.frame)
        hit = scan.range > 0
        ranges = scan.range[hit]
        facts = {
            "lidar": self.lidar.lower(),
            "beams": hit.shape[1],
            "points": int(hit.sum()),
            "median_range": float(np.median(ranges)) if len(ranges) else None,
            "max_range": float(ranges.max()) if len(ranges) else None,
            "file": self.out,
        }
        rows = [("beams", f"{hit.shape[1]:,}"), ("points", f"{len(ranges):,}")]
        if len(ranges):
            rows += [
                ("median range", f"{np.median(ranges):.2f} m"),
                ("maximum range", f"{ranges.max():.2f} m"),
            ]
        title = f"{self.lidar.lower()} in {self.source} on {renderer.device.title}"
        return report(self.json, facts, self.out, table=(title, ("", ""), rows))


def _presets() -> str:
    from fidsplat.capture.lidar import presets

    return ", ".join(presets())


Scan.__doc__ = (Scan.__doc__ or "").replace("{presets}", _presets())
