"""`fidsplat experiment localise`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from fidsplat.commands.output import Device, Json, console, late_progress, option, switch, tell
from fidsplat.experiments.localise import Drive

if TYPE_CHECKING:
    from fidsplat.render.renderer import Renderer


@dataclass
class Localise:
    """A robot drives through a greenhouse and finds its way by tags: how far a simulated camera moves that.

    MuJoCo drives it up one aisle and down the next; wheels, gyroscope and tags go through an error-state
    filter. Compared are odometry alone, ideal corners, an ideal texture, the markers' mixtures, lens, blur,
    rolling shutter, noise, speeds, and how far away tags are used: absolute and relative trajectory errors,
    errors of corners by distance, trajectories as TUM for evo, a page. A run that was stopped goes on where
    it was. Needs the extra `sim`.

    Examples:
      fidsplat experiment localise --quick
      fidsplat experiment localise --variant odometry --variant exact -o drive
    """

    out: Annotated[str, option("DIR", "folder (default: fidsplat-localise)", "-o")] = "fidsplat-localise"
    quick: Annotated[bool, switch("one row of four plants, and the first three variants")] = False
    drive: Drive = field(default_factory=Drive)
    variant: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        option("NAME", "what to compare, once more for each (default: all)"),
    ] = ()
    log: Annotated[
        str | None, option("FILE.mcap|BAG", "the drive of `exact` as a log of ROS 2 as well (extra: logs)")
    ] = None
    video: Annotated[
        str | None, option("FILE.mp4", "the pictures of `exact` as a video as well (extra: video)")
    ] = None
    device: Device = None
    overwrite: Annotated[bool, switch("measure again what is in the folder")] = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.commands.sweeps import need_reports
        from fidsplat.experiments.localise import VARIANTS
        from fidsplat.images.video import check_video
        from fidsplat.util.provenance import digest_of

        need_reports()
        from fidsplat.experiments.localise_sweep import drive_sweep, found_of, table_of, write_report

        asked = replace(self.drive, rows=1, plants=4) if self.quick else self.drive
        names = list(self.variant) or (list(VARIANTS)[:3] if self.quick else list(VARIANTS))
        if self.video is not None:
            check_video(self.video)
        _ = asked.house  # what is wrong with it is said before a device is opened
        renderer = fs.Renderer(self.device)
        logged, source = False, digest_of((asked, renderer.device.title, fs.__version__))
        if self.log is not None:
            from fidsplat.logs import check_log

            logged = check_log(self.log, self.overwrite, source)
        done = 0

        def step(name: str, share: float) -> None:
            progress(name, (done + share) / len(names))

        folder = Path(self.out)
        sweep = drive_sweep(folder, asked, names, renderer, step, self.overwrite)
        with late_progress(console(True)) as progress:
            done = len(names) - len(sweep.left)
            for record in sweep.run():
                done += 1
                step(record.key["variant"], 0.0)
        found, device = found_of(sweep.results), renderer.device.title
        page = write_report(folder, asked, device, found)
        self._record(asked, renderer, None if logged else source)
        rows, length = table_of(found), found[names[0]]["length_m"]
        rows = rows.iloc[:, :6]  # as many as a terminal has room for; the page has all
        return tell(
            self.json,
            {"run": sweep.results.run, "variants": found},
            *(name for name in (str(page), self.log, self.video) if name is not None),
            table=(f"{length:.1f} m", rows.columns, rows.itertuples(index=False)),
        )

    def _record(self, asked: Drive, renderer: Renderer, source: str | None) -> None:
        """Write the log and the video. source: of the log; None: a run that was stopped has written it."""
        from fidsplat.experiments.localise import RATE, VARIANTS, write_log
        from fidsplat.images.video import write_video

        if (self.log is None or source is None) and self.video is None:
            return
        pictures = asked.pictures(VARIANTS["exact"], asked.run(), renderer)
        if self.log is not None and source is not None:
            pictures = write_log(asked, "exact", renderer, self.log, self.overwrite, source)
        steps = pictures if self.video is None else write_video(self.video, pictures, RATE)
        with console(True).status("recording"):
            for _ in steps:
                pass
