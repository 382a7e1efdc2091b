"""Command `fidsplat tradeoff`: measure time and error of quality settings."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fidsplat.commands.options import Devices, Json, check_plot
from fidsplat.commands.output import console, point_label, print_lines, print_table, report, run_sweeps
from fidsplat.commands.progress_lines import duration
from fidsplat.commands.scenes import Cameras, UserScenes, load_user_scenes
from fidsplat.experiments.tradeoff.run import TradeoffSettings
from fidsplat.util import interrupts

if TYPE_CHECKING:
    from fidsplat.experiments.sweep import Sweep

DEFAULT_FOLDER = "fidsplat-tradeoff"


@dataclass
class Tradeoff:
    """Measure time and error of every quality setting.

    Each setting of Quality is varied separately (its values include the constants of gsplat and of the 2DGS
    authors), then several together. Frames of a setting and of the baseline are interleaved, and the image is
    compared with a float64 reference without cut-offs. Markers are also compared with the ideal printed
    texture. Results are JSON lines, written immediately; an interrupted run resumes. Several devices are
    measured one after the other, each into a folder of its name in DIR. Keep the machine idle. --scene
    measures the splats of your own scene from its camera, or from eight poses of --cameras, with --quick from
    two. The command first estimates its time; it prints a table of the measured points, also after Ctrl-C.
    --quick stops after 3 minutes; the same command continues.

      r100k_720p, r1m_1080p            random splats, as in `fidsplat bench`
      r100k_720p_3d, r1m_1080p_3d      3D Gaussians, with each method of rendering them
      hard                             haze, veils, opaque stacks, edge-on, tiny, needles, near, far away
      apriltag, qr2, qr5, qr10, qr22   markers at 0, 60 and 80 degrees, with presets and mixtures;
                                       qr10 with every setting

    Examples:
      fidsplat tradeoff --quick                              a rough measurement, under 3 minutes on two cores
      fidsplat tradeoff -o gpu --device opencl:nvidia        everything
      fidsplat tradeoff --scenes hard --settings alpha_cutoff transmittance_stop
      fidsplat tradeoff --scene room.ply --cameras poses.tum --quick -o room
      fidsplat tradeoff --device opencl:nvidia --device opencl:pocl --plot both.svg
    """

    out: str | None = None
    """DIR: folder for results (default: fidsplat-tradeoff, with --quick fidsplat-tradeoff-quick)"""
    device: Devices = ()
    measurement: TradeoffSettings = field(default_factory=TradeoffSettings)
    scene: UserScenes = ()
    cameras: Cameras = None
    plot: str | None = None
    """FILE.svg: also write a chart of time and error, or FILE.png (extra: experiments)"""
    json: Json = False

    def run(self) -> int:
        from fidsplat.experiments.tradeoff.run import QUICK_VIEWS, prepared
        from fidsplat.experiments.tradeoff.scenes import user_views
        from fidsplat.render.renderer import default_device

        if self.plot is not None:
            check_plot(self.plot, "pandas")
        folder = Path(self.out or DEFAULT_FOLDER + ("-quick" if self.measurement.quick else ""))
        devices = tuple(dict.fromkeys(self.device)) or (default_device(),)
        max_views = QUICK_VIEWS if self.measurement.quick else None
        views = user_views(
            load_user_scenes(self.scene, self.cameras, self.measurement.scenes or (), max_views)
        )
        folders = [folder / name.replace(":", "-") for name in devices] if len(devices) > 1 else [folder]
        with ExitStack() as stack:
            # open all devices first, so that a missing device is reported before others are measured
            sweeps = [
                stack.enter_context(prepared(self.measurement, out, device, views))
                for out, device in zip(folders, devices, strict=True)
            ]
            for sweep in sweeps:
                _print_estimate(sweep)
            try:
                measured = run_sweeps(sweeps)
            except KeyboardInterrupt:
                with interrupts.postponed():
                    _print_results(sweeps, self.json)
                raise
        if not self.json:
            _print_results(sweeps, False)
        if self.plot is not None:
            from fidsplat.experiments.tradeoff.plot import write_plot

            write_plot(folders, Path(self.plot))
        refused = [
            f"{point_label(record.key)}, {record.run['device']}: {record.result['error']}"
            for record in measured
            if record.failed
        ]
        files = [str(sweep.results.file) for sweep in sweeps]
        points = sum(len(sweep.points) for sweep in sweeps)
        left = sum(len(sweep.left) for sweep in sweeps)
        lines = [*(f"not measured: {line}" for line in refused), *files]
        if left > len(refused):  # the time limit ended the sweep
            lines.append(f"{left} of {points} points are not measured yet; the same command continues")
        return report(self.json, {"files": files, "points": points, "refused": refused}, *lines)


def _print_estimate(sweep: Sweep) -> None:
    """Print the number of missing points and their estimated time on stderr."""
    if sweep.estimate is None or not (left := len(sweep.left)):
        return
    seconds = sweep.estimate()
    line = f"{sweep.name}: {left} points, about {duration(seconds)}"
    if sweep.limit is not None and seconds > sweep.limit.seconds:
        line += f"; --quick stops after {duration(sweep.limit.seconds)}, the same command continues"
    print_lines(console(True), line)


def _print_results(sweeps: Sequence[Sweep], as_json: bool) -> None:
    """Print each setting's time relative to the baseline and largest error, for each device."""
    for sweep in sweeps:
        by_scene: dict[tuple[str, str], list[dict[str, Any]]] = {}
        for record in sweep.records:
            if not record.failed:
                by_scene.setdefault((record.key["setting"], record.key["value"]), []).append(record.result)
        if by_scene:
            rows = [
                (
                    *names,
                    len(results),
                    f"{statistics.median(result['ratio'] for result in results):.2f}",
                    f"{max(result['maximum'] for result in results):.2g}",
                )
                for names, results in by_scene.items()
            ]
            title = f"{sweep.name}: {len(sweep.records)} of {len(sweep.points)} points"
            heads = ("setting", "value", "views", "time / baseline", "largest error")
            print_table(console(as_json), title, heads, rows)
