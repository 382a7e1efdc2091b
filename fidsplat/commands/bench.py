"""`fidsplat bench`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from fidsplat.commands.output import (
    Devices,
    console,
    json_text,
    option,
    print_table,
    progress_bar,
    say,
    writable_file,
)
from fidsplat.commands.own_scenes import Cameras, OwnScenes, own_scenes_of
from fidsplat.commands.sweeps import check_plot
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write

if TYPE_CHECKING:
    from rich.console import Console

    from fidsplat.experiments.bench.measure import Bench as Measuring
    from fidsplat.experiments.bench.measure import Result

_LEGEND = (
    "ms: median (quartiles) of whole frames, medians of the stages by the device's own clock; splats "
    "resident, picture left on the device. host: until the call returns. x roofline: how many times the "
    "least that the device's measured best rates allow (devlog/roofline.md)."
)


@dataclass
class Bench:
    """Time frames of standard scenes on one device, or on several side by side.

    The devices draw the same frames in turn, with the cut-off and stop that all renderers share and in
    precise arithmetic (1/255, 1e-4; `fidsplat tradeoff` prices others). For each scene: milliseconds per
    frame and per stage, what there was to draw, device memory, and how many times the device's roofline that
    is: the least that its measured rates allow. Without --scenes: tag, r100k_720p, r1m_1080p and
    tag_in_million, about a minute on two cores. A run that is stopped shows what it has.

      tag             an AprilTag alone, 640 x 480
      r100k_720p      100,000 random splats, 1280 x 720
      r1m_1080p       1,000,000, 1920 x 1080
      r5m_1080p       5,000,000, 1920 x 1080
      r20m_4k         20,000,000, 3840 x 2160
      r100k_720p_3d   the same of 3D Gaussians; likewise r1m_1080p_3d, r5m_1080p_3d
      qr_wall         200 QR codes of version 22 on a wall, 1920 x 1080
      tag_in_million  an AprilTag before 1,000,000 random splats, 1920 x 1080

    --scene takes one's own instead, with its camera; --cameras poses from which it is seen, of which eight
    are drawn. Splats are timed alone: its effects, and what moves in it, are left out.

    Examples:
      fidsplat bench
      fidsplat bench --scenes r100k_720p r1m_1080p --repeats 50
      fidsplat bench --device opencl:nvidia --device opencl:pocl --json figures.json
      fidsplat bench --scenes all --json -
      fidsplat bench --scene room.ply --cameras poses.tum
      fidsplat bench --scene room.ply --device opencl:nvidia --device opencl:pocl --plot room.svg
    """

    scenes: Annotated[
        tuple[str, ...],
        option("NAME...", "scenes, or all (default: tag r100k_720p r1m_1080p tag_in_million)"),
    ] = ()
    scene: OwnScenes = ()
    cameras: Cameras = None
    device: Devices = ()
    repeats: Annotated[int, option("N", "frames of each scene on each device that count (default: 20)")] = 20
    json: Annotated[
        str | None,
        option("FILE", "write all figures to a file as well, after each scene; - for stdout alone"),
    ] = None
    plot: Annotated[
        str | None,
        option("FILE.svg", "a chart of the frames' times as well, or FILE.png (extra: experiments)"),
    ] = None

    def run(self) -> int:
        from rich.progress import Progress, TextColumn

        from fidsplat.experiments.bench.catalogue import BENCH_SCENES, scene_names
        from fidsplat.experiments.bench.measure import Bench as Measuring
        from fidsplat.render.renderer import default_device

        if self.repeats < 1:
            raise InputError(f"--repeats is {self.repeats}; give a number of frames, at least 1")
        if self.plot is not None:
            check_plot(self.plot)
        known = own_scenes_of(self.scene, self.cameras, self.scenes) or BENCH_SCENES
        scenes = tuple(known) if self.scene else scene_names(self.scenes)
        if self.json not in (None, "-"):
            writable_file(self.json)
        where = console(self.json == "-")
        interrupted, measuring = False, None
        devices = self.device or (default_device(),)
        frames = len(scenes) * len(set(devices)) * self.repeats
        columns = (*Progress.get_default_columns(), TextColumn("{task.fields[now]}"))
        with progress_bar(where, *columns) as progress:
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
                where.print(f"These were {', '.join(scenes)}; more with --scenes NAME... or --scenes all.")
        if interrupted:
            raise KeyboardInterrupt
        return 1 if any(result.timer.error for result in results) else 0

    def _save(self, measuring: "Measuring", scenes: tuple[str, ...], interrupted: bool) -> None:
        if self.json in (None, "-"):
            return
        with atomic_write(self.json) as stream:
            stream.write(json_text(_record(measuring.results, scenes, interrupted)).encode())
            stream.write(b"\n")


def _record(results: "list[Result]", scenes: tuple[str, ...], interrupted: bool) -> dict[str, Any]:
    from fidsplat import __version__

    return {
        "fidsplat": __version__,
        "scenes": list(scenes),
        "interrupted": interrupted,
        "results": [result.as_dict() for result in results],
    }


def _print(results: "list[Result]", where: "Console", about: dict[str, str]) -> None:
    """A table for each scene; the devices are its columns. about: what scenes are, by name."""
    for scene in dict.fromkeys(result.scene for result in results):
        drawn = [result for result in results if result.scene == scene]
        for result in drawn:
            if result.timer.error:
                say(where, f"{scene} on {result.device.name}: {result.timer.error}")
        drawn = [result for result in drawn if result.timer.ms]
        if drawn:
            _print_scene(f"{scene}: {about[scene]}", drawn, where)
    if any(result.timer.ms for result in results):
        where.print(_LEGEND, markup=False)


def _print_scene(title: str, drawn: "list[Result]", where: "Console") -> None:
    heads, rows = ["ms"], [["frame"]]
    stages = list(dict.fromkeys(stage for result in drawn for stage in result.timer.parts))
    rows += [[stage] for stage in stages]
    for result in drawn:
        heads += [result.device.name, "x roofline"]
        low, middle, high = result.timer.quartiles
        rows[0] += [f"{middle:.2f} ({low:.2f} to {high:.2f})", _times(result, "frame")]
        for row, stage in zip(rows[1:], stages, strict=True):
            ms = result.timer.part_medians.get(stage)
            row += ["-" if ms is None else f"{ms:.2f}", _times(result, stage)]
    facts = ("host", "first frame", *drawn[0].counts, "splats/s", "memory")
    for fact in facts:
        rows.append([fact])
        for result in drawn:
            rows[-1] += [_fact(result, fact), ""]
    print_table(where, title, heads, rows)
    for result in drawn:
        device, frames = result.device, len(result.timer.ms)
        say(where, f"{device.name}: {device.title}, {device.version}; {frames} frames")
    where.print()


def _times(result: "Result", name: str) -> str:
    times = result.times_roofline.get(name)
    return "-" if times is None else f"{times:.1f}"


def _fact(result: "Result", fact: str) -> str:
    if fact == "host":
        return f"{result.host:.3f}"
    if fact == "first frame":
        return f"{result.first_frame_ms:.1f}"
    if fact == "splats/s":
        return f"{1e-3 * result.counts['splats'] / result.timer.quartiles[1]:.2f} M"
    if fact == "memory":
        held = result.memory_bytes
        return "-" if held is None else f"{held / 2**30:.3f} GiB"
    count = result.counts.get(fact)
    return "-" if count is None else f"{count:,}"
