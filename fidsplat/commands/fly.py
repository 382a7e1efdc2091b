"""`fidsplat fly`."""

from __future__ import annotations

import time
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from fidsplat.commands.output import (
    Json,
    MemoryBudget,
    Overwrite,
    SceneDevice,
    SceneOutputs,
    SceneQuality,
    bytes_of,
    check_words,
    console,
    counted,
    late_progress,
    names_of,
    option,
    switch,
    tell,
    writable_file,
)
from fidsplat.commands.remote import RayAddress, Workers, check_workers
from fidsplat.commands.render import load_source
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rich.console import Console

    from fidsplat.cameras import Trajectory
    from fidsplat.render.flight import Flight, FlightFolder
    from fidsplat.scenes import Scene

DEFAULT_FOLDER = "fidsplat-flight"


@dataclass
class Fly:
    """Draw a scene along a trajectory: a picture for each moment, a contact sheet, a video.

    DIR/rgb/000000.png and so on, likewise for other outputs; trajectory.tum and transforms.json have the pose
    of each picture, so that the folder is a data set too. A run that is stopped goes on where it was. What
    moves in the scene moves by the trajectory's clock, and a shutter of the scene sees the camera move.

    Files of poses, camera to world (docs/trajectories.md): TUM, KITTI, COLMAP's images.txt or folder,
    nerfstudio's transforms.json. Without --trajectory the camera moves as the scene file says.

    Examples:
      fidsplat fly scene.toml --trajectory flight.tum -o flight --video flight.mp4
      fidsplat fly room.ply --trajectory poses.txt --file-rate 10 --smooth --outputs rgb,depth
      fidsplat fly moving.toml --times 0,0.5,1
      fidsplat fly scene.toml --trajectory flight.tum --outputs rgb,label --log run.mcap --coco truth.json
      fidsplat fly scene.toml --trajectory flight.tum --ray ray://HOST:10001       by a cluster
    """

    source: Annotated[tyro.conf.Positional[str], option("SCENE.toml|FILE.ply|STORE.fss", "what to draw")]
    trajectory: Annotated[
        str | None, option("FILE", "the camera's poses (default: the scene's [[camera.motion]])")
    ] = None
    out: Annotated[
        str,
        option(
            "DIR|RUN.mcap",
            f"folder for pictures (default: {DEFAULT_FOLDER}), or a log, with the pictures in RUN",
            "-o",
        ),
    ] = DEFAULT_FOLDER
    rate: Annotated[float, option("HZ", "pictures a second, also of the video (default: 30)")] = 30.0
    times: Annotated[
        str | None, option("T,T,...", "seconds on the trajectory's clock, instead of --rate")
    ] = None
    file_rate: Annotated[float, option("HZ", "poses a second of a file that has no times (default: 10)")] = (
        10.0
    )
    smooth: Annotated[bool, switch("curves through the poses, without a kink there")] = False
    video: Annotated[str | None, option("FILE.mp4", "a video of the first output as well (extra: video)")] = (
        None
    )
    log: Annotated[
        str | None,
        option("FILE.mcap|BAG", "a log of ROS 2 as well: pictures, intrinsics, poses (extra: logs)"),
    ] = None
    coco: Annotated[
        str | None, option("FILE.json", "where markers are in each picture as well, as COCO annotations")
    ] = None
    outputs: SceneOutputs = None
    device: SceneDevice = None
    quality: SceneQuality = None
    memory_budget: MemoryBudget = None
    ray: RayAddress = None
    workers: Workers = None
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.cameras.trajectory import check_rate
        from fidsplat.commands.flight_records import write_log, write_truth
        from fidsplat.images.video import check_video
        from fidsplat.render.flight import Flight, FlightFolder

        names = names_of(self.outputs)
        check_words(names, self.quality)
        budget = bytes_of("--memory-budget", self.memory_budget)
        check_workers(self.ray, self.workers)
        if self.out.endswith(".mcap"):
            self.log, self.out = self.log or self.out, self.out.removesuffix(".mcap")
        check_rate(self.rate)
        if self.video is not None:
            check_video(self.video)
        if self.coco is not None:
            writable_file(self.coco)
        given = self.trajectory
        path = None if given is None else fs.load_trajectory(given, self.file_rate, self.smooth)
        where = console(self.json)
        with late_progress(console(True)) as progress:
            scene = load_source(self.source, self.quality, progress)
        path = path or _own_motion(self.source, scene, self.smooth)
        times = path.sampled(self.rate).times if self.times is None else _times(self.times)
        flight = Flight(scene, path, times, scene.capture.with_(outputs=names, quality=self.quality))
        with self._drawn_by(flight, budget, where) as (title, draw):
            logged = self._logged(flight.key(title))
            folder = FlightFolder(self.out, flight, title, self.overwrite, self.source)
            begun = time.perf_counter()
            left = len(folder.left())
            list(counted("pictures", draw(folder), len(flight), len(flight) - left))
            seconds = time.perf_counter() - begun
        sheet = folder.write_sheet()
        if self.video is not None:
            list(counted("video", folder.write_video(self.video, self.rate), len(flight)))
        if self.log is not None and not logged:
            list(counted("log", write_log(folder, self.log, self.overwrite), len(flight)))
        if self.coco is not None:
            list(counted("truth", write_truth(folder, self.coco), len(flight)))
        return self._tell(folder, sheet, left, seconds)

    def _logged(self, source: str) -> bool:
        """Whether the log of a flight is there already, of a run that was stopped later."""
        if self.log is None:
            return False
        from fidsplat.logs import check_log

        return check_log(self.log, self.overwrite, source)

    @contextmanager
    def _drawn_by(
        self, flight: Flight, budget: int | None, where: Console
    ) -> Iterator[tuple[str, Callable[[FlightFolder], Iterator[int]]]]:
        """What draws, in words, and how it draws what is left of a flight."""
        from fidsplat.render.renderer import Renderer, default_device

        device = self.device or flight.scene.device or default_device()
        if self.ray is None:
            with where.status("opening the device"):
                renderer = Renderer(device, budget)
            yield renderer.device.title, lambda folder: folder.draw(renderer)
            return
        from fidsplat.remote.flights import FlightWork, draw
        from fidsplat.remote.ray_engine import ray_engine

        with ExitStack() as stack:
            with where.status("starting workers"):
                work = FlightWork(flight, device, budget)
                engine = stack.enter_context(ray_engine(self.ray, work, self.workers))
            yield engine.title, lambda folder: draw(folder, engine, engine.workers)

    def _tell(self, folder: FlightFolder, sheet: Path, drawn: int, seconds: float) -> int:
        frames = len(folder.flight)
        facts: dict[str, Any] = {"source": self.source, "device": folder.device, "frames": frames}
        facts |= {"drawn": drawn, "seconds": seconds, "folder": str(folder.folder)}
        facts |= {"contact_sheet": str(sheet), "video": self.video, "log": self.log, "coco": self.coco}
        kept = f" ({frames - drawn} were there already)" if drawn < frames else ""
        rate = f", {drawn / seconds:.1f} a second" if drawn else ""
        lines = [f"{frames} pictures{kept} on {folder.device} in {seconds:.1f} s{rate}", str(sheet)]
        more = (name for name in (self.video, self.log, self.coco) if name is not None)
        return tell(self.json, facts, *lines, *more)


def _own_motion(source: str, scene: Scene, smooth: bool) -> Trajectory:
    """The camera's own keyframes, camera to world."""
    from fidsplat.cameras import Trajectory

    if not isinstance(scene.camera_motion, Trajectory):
        raise InputError(f"{source} has no [[camera.motion]] to fly along; give --trajectory FILE")
    back = scene.camera_motion.inverse()
    return Trajectory(back.times, back.poses, smooth)


def _times(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"--times is {text!r}; give seconds with commas between, e.g. 0,0.5,1") from None
