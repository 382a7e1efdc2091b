"""Command `fidsplat experiment localise`: localise a robot by tags and a LiDAR."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from fidsplat.commands.options import Device, Json, log_is_complete, require_packages
from fidsplat.commands.output import console, delayed_progress, report
from fidsplat.experiments.localise import Drive

if TYPE_CHECKING:
    from fidsplat.render.renderer import Renderer


@dataclass
class Localise:
    """Localise a robot by tags and a LiDAR in a greenhouse, with ideal and simulated sensors.

    MuJoCo drives the robot up one aisle and down the next; an error-state filter fuses wheels, gyroscope,
    tags and matches of LiDAR scans from logs of ROS 2 messages (MCAP). Variants: odometry only, ideal
    corners, an ideal texture, mixtures of the markers, lens, blur, rolling shutter, noise, speeds, the
    largest distance of tags, and a LiDAR without each sensor in turn. Results: absolute and relative
    trajectory errors, corner errors by distance, logs, trajectories as TUM for evo, a page. An interrupted
    run resumes. Needs the extras `sim` and `logs`.

    Examples:
      fidsplat experiment localise --quick
      fidsplat experiment localise --sensors -o greenhouse
      fidsplat experiment localise --variant odometry --variant exact -o drive
    """

    out: str = "fidsplat-localise"
    """DIR: folder"""
    quick: bool = False
    """measure one row of four plants and the first three variants"""
    sensors: bool = False
    """measure with a LiDAR, and without each sensor in turn"""
    drive: Drive = field(default_factory=Drive)
    variant: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """NAME: variant to measure, repeat for several (default: all)"""
    log: str | None = None
    """FILE.mcap|BAG: also write the drive of `exact` as a ROS 2 log (extra: logs)"""
    video: str | None = None
    """FILE.mp4: also write the images of `exact` as a video (extra: video)"""
    device: Device = None
    overwrite: bool = False
    """replace existing results"""
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.experiments.localise import SENSORS, VARIANTS
        from fidsplat.images.video import check_video
        from fidsplat.util.provenance import digest_of

        require_packages()
        require_packages("the robot's drive", ("rosbags", "mcap"), "logs")
        require_packages("the robot's drive", ("mujoco", "small_gicp"), "sim")
        from fidsplat.experiments.localise_sweep import drive_sweep, found_of, table_of, write_report

        drive = replace(self.drive, rows=1, plants=4) if self.quick else self.drive
        names = list(SENSORS) if self.sensors else list(VARIANTS)[:3] if self.quick else list(VARIANTS)
        names = list(self.variant) or names
        if self.video is not None:
            check_video(self.video)
        _ = drive.house  # validates the settings before a device is opened
        renderer = fs.Renderer(self.device)
        source = digest_of((drive, renderer.device.title, fs.__version__))
        has_log = log_is_complete(self.log, self.overwrite, source)
        done = 0

        def step(name: str, fraction: float) -> None:
            progress(name, (done + fraction) / len(names))

        folder = Path(self.out)
        sweep = drive_sweep(folder, drive, names, renderer, step, self.overwrite)
        with delayed_progress() as progress:
            done = len(names) - len(sweep.left)
            for record in sweep.run():
                done += 1
                step(record.key["variant"], 0.0)
        results, device = found_of(sweep.results), renderer.device.title
        page = write_report(folder, drive, device, results)
        self._record(drive, renderer, None if has_log else source)
        rows, length = table_of(results), results[names[0]]["length_m"]
        rows = rows.iloc[:, :7]  # the width of a terminal; the page has all columns
        return report(
            self.json,
            {"run": sweep.results.run, "variants": results},
            *(name for name in (str(page), self.log, self.video) if name is not None),
            table=(f"{length:.1f} m", rows.columns, rows.itertuples(index=False)),
        )

    def _record(self, drive: Drive, renderer: Renderer, source: str | None) -> None:
        """Write the video, and the log unless source is None (the log is complete)."""
        from fidsplat.experiments.localise import RATE, VARIANTS, write_log
        from fidsplat.images.video import write_video

        if (self.log is None or source is None) and self.video is None:
            return
        images = drive.images(VARIANTS["exact"], drive.run(), renderer)
        if self.log is not None and source is not None:
            images = write_log(drive, "exact", renderer, self.log, self.overwrite, source)
        steps = images if self.video is None else write_video(self.video, images, RATE)
        with console(True).status("recording"):
            for _ in steps:
                pass
