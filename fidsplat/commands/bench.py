"""Command `fidsplat bench`: time frames of standard scenes."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fidsplat.commands.options import Devices, check_plot
from fidsplat.commands.output import (
    console,
    delayed_progress,
    json_text,
    print_lines,
    print_table,
    progress_bar,
)
from fidsplat.commands.scenes import Cameras, UserScenes, load_user_scenes
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_file, write_file

if TYPE_CHECKING:
    from rich.console import Console

    from fidsplat.experiments.bench.measure import Bench as Measuring
    from fidsplat.experiments.bench.measure import Result


@dataclass
class Bench:
    """Time frames of standard scenes on one or several devices.

    The devices render the same frames interleaved, with the settings that renderers share: alpha cut-off
    1/255, transmittance stop 1e-4, precise arithmetic (`fidsplat tradeoff` measures others). The table shows
    for each scene the milliseconds per frame and stage, counts, device memory, and the multiple of the
    device's roofline, the minimum time at its measured peak rates. Without --scenes: tag, r100k_720p,
    r1m_1080p and tag_in_million, about a minute on two cores. An interrupted run shows its results so far.

      tag             one AprilTag, 640 x 480
      r100k_720p      100,000 random splats, 1280 x 720
      r1m_1080p       1,000,000, 1920 x 1080
      r5m_1080p       5,000,000, 1920 x 1080
      r20m_4k         20,000,000, 3840 x 2160
      r100k_720p_3d   the same of 3D Gaussians; likewise r1m_1080p_3d, r5m_1080p_3d
      qr_wall         200 QR codes of version 22 on a wall, 1920 x 1080
      tag_in_million  an AprilTag before 1,000,000 random splats, 1920 x 1080

    --suite compares renderers by time and error on scenes of every regime: uniform, skewed, haze, street,
    markers, captured, batches, scaling. Each renderer runs in a process of its own: fidsplat on every device
    of this machine (or --device), and the renderers of --adapters. Images are compared with float64
    references. It takes about 10 minutes on two cores, with --quick 90 seconds. Results are written after
    each scene; an interrupted run resumes. --scenes selects scenes (haze, street: one scene) or all scenes of
    the other regimes. benchmarks/splatmark.py makes a site of the results.

    --scene measures your own scene with everything that it requests (quality, outputs, lens, shutter,
    motions, markers, fog, sensor), from its camera or from eight poses of --cameras. The table shows the time
    that each effect adds.

    Examples:
      fidsplat bench
      fidsplat bench --scenes r100k_720p r1m_1080p --repeats 50
      fidsplat bench --device opencl:nvidia --device opencl:pocl --json figures.json
      fidsplat bench --scenes all --json -
      fidsplat bench --scene room.ply --cameras poses.tum
      fidsplat bench --scene room.ply --device opencl:nvidia --device opencl:pocl --plot room.svg
      fidsplat bench --suite --quick
      fidsplat bench --suite --adapters benchmarks/adapters --json benchmarks/results/suite-NAME.json
    """

    scenes: tuple[str, ...] = ()
    """NAME...: scenes, or all (default: tag r100k_720p r1m_1080p tag_in_million)"""
    scene: UserScenes = ()
    cameras: Cameras = None
    device: Devices = ()
    repeats: int = 20
    """N: timed frames per scene and device; for --scene 3, or as many as start within a minute"""
    json: str | None = None
    """FILE: also write all figures to a file after each scene; - for stdout only"""
    plot: str | None = None
    """FILE.svg: also write a chart of the frame times, or FILE.png (extra: experiments)"""

    suite: bool = False
    """compare renderers by time and error on scenes of every regime"""
    quick: bool = False
    """with --suite: few scenes and frames"""
    adapters: Path | None = None
    """DIR: with --suite: folder of other renderers (benchmarks/adapters)"""
    overwrite: bool = False
    """with --suite: replace existing results"""

    def run(self) -> int:
        if self.suite:
            return self._run_suite()
        if self.quick or self.overwrite or self.adapters is not None:
            raise InputError(
                "--quick, --adapters and --overwrite must be given with --suite, got bench without it; add "
                "--suite, or omit them"
            )
        from rich.progress import Progress, TextColumn

        from fidsplat.experiments.bench.catalogue import BENCH_SCENES, scene_names
        from fidsplat.experiments.bench.measure import Bench as Measuring
        from fidsplat.render.renderer import default_device

        if self.repeats < 1:
            raise InputError(f"--repeats must be at least 1 frame, got {self.repeats}")
        if self.plot is not None:
            check_plot(self.plot)
        known = load_user_scenes(self.scene, self.cameras, self.scenes) or BENCH_SCENES
        scenes = tuple(known) if self.scene else scene_names(self.scenes)
        if self.json not in (None, "-"):
            writable_file(self.json)
        where = console(self.json == "-")
        interrupted, measuring = False, None
        devices = self.device or (default_device(),)
        frames = sum(1 + len(known[name].without) for name in scenes) * len(set(devices)) * self.repeats
        columns = (*Progress.get_default_columns(), TextColumn("{task.fields[now]}"))
        with progress_bar(console(True), *columns) as progress:
            task = progress.add_task("frames", total=frames, now="")
            try:
                measuring = Measuring(
                    devices,
                    lambda words: progress.update(task, now=words),
                    lambda: progress.advance(task),
                    known,
                )
                for scene in scenes:
                    measuring.run(scene, self.repeats)
                    self._save(measuring, scenes, interrupted)
            except KeyboardInterrupt:
                interrupted = True
        results = measuring.results if measuring else []
        with interrupts.postponed():
            if measuring:
                self._save(measuring, scenes, interrupted)
            if self.plot is not None and any(result.timer.ms for result in results):
                from fidsplat.experiments.bench.plot import write_plot

                write_plot(results, Path(self.plot))
        if self.json == "-":
            print(json_text(_record(results, scenes, interrupted)))
        else:
            _print(results, where, {name: scene.about for name, scene in known.items()})
            if not (self.scenes or self.scene) and not interrupted:
                where.print(f"Measured {', '.join(scenes)}; --scenes NAME... or --scenes all measures more.")
        if interrupted:
            raise KeyboardInterrupt
        return 1 if any(result.timer.error for result in results) else 0

    def _run_suite(self) -> int:
        from fidsplat.backends import devices
        from fidsplat.experiments.bench import suite
        from fidsplat.experiments.bench.regimes import suite_scenes
        from fidsplat.render.renderer import Renderer

        if self.scene or self.cameras or self.plot or self.json == "-":
            raise InputError(
                "--suite must be given with a FILE as --json, without --scene, --cameras and --plot"
            )
        usable = (info.name for info in devices() if info.usable and not info.always_float64)
        names = tuple(dict.fromkeys(self.device)) or tuple(usable)
        large = any(Renderer(name).device.kind == "gpu" for name in names)
        scenes = suite_scenes(self.scenes, self.quick, large)
        renderers = suite.fidsplat_renderers(names)
        if self.adapters is not None:
            renderers |= suite.adapter_renderers(self.adapters)
        file = writable_file(self.json or f"fidsplat-suite{'-quick' if self.quick else ''}.json")
        command = " ".join(["fidsplat", *sys.argv[1:]])
        measuring = suite.Suite(
            file, scenes, renderers, suite.QUICK if self.quick else suite.FULL, command, self.overwrite
        )
        with delayed_progress() as progress:
            results = measuring.run(progress)
        failed = [result for result in results if "error" in result]
        for result in failed:
            print_lines(console(True), f"{result['scene']}, {result['renderer']}: {result['error']}")
        print_lines(console(False), f"{len(results)} results in {file}")
        return 1 if failed else 0

    def _save(self, measuring: "Measuring", scenes: tuple[str, ...], interrupted: bool) -> None:
        if self.json in (None, "-"):
            return
        write_file(self.json, json_text(_record(measuring.results, scenes, interrupted)) + "\n")


def _record(results: "list[Result]", scenes: tuple[str, ...], interrupted: bool) -> dict[str, Any]:
    from fidsplat import __version__

    return {
        "fidsplat": __version__,
        "scenes": list(scenes),
        "interrupted": interrupted,
        "results": [result.as_dict() for result in results],
    }


def _print(results: "list[Result]", where: "Console", about: dict[str, str]) -> None:
    """Print a table per scene with one column per device. about: descriptions of scenes by name."""
    from fidsplat.experiments.bench.table import LEGEND, scene_table

    for scene in dict.fromkeys(result.scene for result in results):
        measured = [result for result in results if result.scene == scene]
        for result in measured:
            if result.timer.error:
                print_lines(where, f"{scene} on {result.device.name}: {result.timer.error}")
        measured = [result for result in measured if result.timer.ms]
        if measured:
            print_table(where, f"{scene}: {about[scene]}", *scene_table(measured))
            for result in measured:
                device, frames = result.device, len(result.timer.ms)
                print_lines(where, f"{device.name}: {device.title}, {device.version}; {frames} frames")
            where.print()
    if any(result.timer.ms for result in results):
        where.print(LEGEND, markup=False)
