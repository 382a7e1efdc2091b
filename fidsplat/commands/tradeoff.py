"""`fidsplat tradeoff`: what accuracy costs in time, measured; `fidsplat tradeoff report`."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

from fidsplat.commands.output import Devices, Json, option, tell
from fidsplat.commands.own_scenes import Cameras, OwnScenes, own_scenes_of
from fidsplat.commands.sweeps import (
    Folders,
    ReportTo,
    check_plot,
    need_reports,
    run_sweeps,
    words,
)
from fidsplat.experiments.tradeoff.run import TradeoffSettings

DEFAULT_FOLDER = "fidsplat-tradeoff"


@dataclass
class TradeoffReport:
    """Write a report from results: what each constant saves and costs, and what to make of it.

    Results of several devices stand side by side; results of the same device in several folders are joined,
    and of a point that was measured twice the larger measurement counts. Charts and a small table of each
    device's results lie in the report's folder, or for FILE.md in a folder of that name; the report can be
    made again from those tables. What the text says of the numbers is worked out from them.

    Examples:
      fidsplat tradeoff report
      fidsplat tradeoff report cpu gpu -o docs/accuracy.md
    """

    folders: Annotated[Folders, option("DIR", f"folders with results (default: {DEFAULT_FOLDER})")] = ()
    out: ReportTo = None
    json: Json = False

    def run(self) -> int:
        need_reports()
        from fidsplat.experiments.tradeoff.report import write_report

        folders = [Path(folder) for folder in self.folders or (DEFAULT_FOLDER,)]
        files = write_report(folders, Path(self.out or folders[0]))
        return tell(self.json, {"files": [str(file) for file in files]}, f"report in {files[0]}")


@dataclass
class Tradeoff:
    """Measure what each constant of a splat renderer costs in time and buys in accuracy.

    Each knob of Quality is turned alone (the constants of gsplat and of the 2DGS authors among its values),
    then several together. A setting draws in turn with the base, frame by frame, and its picture is compared
    with a float64 one that leaves nothing out. Markers are also compared with the ideal printed texture, and
    tilted until nobody reads them. Results are JSON lines, written as they come; a run that was stopped goes
    on where it was. Several devices measure one after the other, each into a folder of its name in DIR. Keep
    the machine quiet. --scene takes one's own scene instead, as for `fidsplat bench`.

      r100k_720p, r1m_1080p            random splats, as in `fidsplat bench`
      r100k_720p_3d, r1m_1080p_3d      of 3D Gaussians: the ways of drawing them
      hard                             haze, veils, opaque stacks, edge-on, tiny, needles, near, far away
      apriltag, qr2, qr5, qr10, qr22   markers at 0, 60 and 80 degrees: presets and ways of making them;
                                       of qr10 every knob

    Examples:
      fidsplat tradeoff --quick                              a rough picture, under 3 minutes on two cores
      fidsplat tradeoff -o gpu --device opencl:nvidia        everything
      fidsplat tradeoff --scenes hard --knobs alpha_cutoff transmittance_stop
      fidsplat tradeoff --scene room.ply --cameras poses.tum --quick -o room
      fidsplat tradeoff --device opencl:nvidia --device opencl:pocl --plot both.svg
      fidsplat tradeoff report cpu gpu -o docs/accuracy.md   a page from results
    """

    PARTS: ClassVar[dict[str, type]] = {"report": TradeoffReport}

    out: Annotated[
        str | None,
        option(
            "DIR",
            f"folder for results (default: {DEFAULT_FOLDER}, with --quick {DEFAULT_FOLDER}-quick)",
            "-o",
        ),
    ] = None
    device: Devices = ()
    settings: TradeoffSettings = field(default_factory=TradeoffSettings)
    scene: OwnScenes = ()
    cameras: Cameras = None
    plot: Annotated[
        str | None,
        option("FILE.svg", "a chart of time against error as well, or FILE.png (extra: experiments)"),
    ] = None
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.tradeoff.run import prepared
        from fidsplat.experiments.tradeoff.scenes import own_pictures
        from fidsplat.render.renderer import default_device

        if self.plot is not None:
            check_plot(self.plot, "pandas")
        folder = Path(self.out or DEFAULT_FOLDER + ("-quick" if self.settings.quick else ""))
        devices = tuple(dict.fromkeys(self.device)) or (default_device(),)
        own = own_pictures(own_scenes_of(self.scene, self.cameras, self.settings.scenes))
        folders = [folder / name.replace(":", "-") for name in devices] if len(devices) > 1 else [folder]
        with ExitStack() as stack:
            # all are opened first: one that is not there is said before minutes of another
            sweeps = [
                stack.enter_context(prepared(self.settings, out, device, own))
                for out, device in zip(folders, devices, strict=True)
            ]
            measured = run_sweeps(sweeps)
        if self.plot is not None:
            from fidsplat.experiments.tradeoff.report import write_plot

            write_plot(folders, Path(self.plot))
        refused = [
            f"{words(record.key)}, {record.run['device']}: {record.result['error']}"
            for record in measured
            if record.failed
        ]
        files = [str(sweep.results.file) for sweep in sweeps]
        points = sum(len(sweep.points) for sweep in sweeps)
        lines = [*(f"not measured: {line}" for line in refused), *files]
        lines.append(f"a page of them: fidsplat tradeoff report {' '.join(map(str, folders))}")
        return tell(self.json, {"files": files, "points": points, "refused": refused}, *lines)
