"""Command `fidsplat fly`: render a scene along a trajectory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fidsplat.commands.options import Json, Overwrite, check_compressed, log_is_complete, parse_numbers
from fidsplat.commands.output import console, report, show_progress
from fidsplat.commands.scenes import RenderInput, Size
from fidsplat.util.errors import InputError
from fidsplat.util.files import writable_file

if TYPE_CHECKING:
    import numpy as np

    from fidsplat.cameras import Trajectory
    from fidsplat.render.flight import Flight, FlightFolder
    from fidsplat.scenes import Scene
    from fidsplat.vision.bop import BopScene
    from fidsplat.vision.truth import Truth

DEFAULT_FOLDER = "fidsplat-flight"
CAMERA = "camera"
"""name of the frame and topics of the camera in a ROS 2 log"""


@dataclass
class Fly(RenderInput):
    """Render a scene along a trajectory to images, a contact sheet and a video.

    DIR/rgb/000000.png and so on are the frames, likewise for other outputs. DIR/trajectory.tum and
    DIR/transforms.json contain their poses, so that the folder is also a data set. An interrupted run
    resumes. Motions of the scene use the times of the trajectory, and a shutter of the scene includes the
    motion of the camera.

    Trajectory files contain camera-to-world poses (docs/formats.md#trajectories): TUM, KITTI, COLMAP's
    images.txt or folder, nerfstudio's transforms.json. The default is the scene's [[camera.motion]].

    Examples:
      fidsplat fly scene.toml --trajectory flight.tum -o flight --video flight.mp4
      fidsplat fly room.ply --trajectory poses.txt --file-rate 10 --smooth --outputs rgb,depth
      fidsplat fly moving.toml --times 0,0.5,1
      fidsplat fly scene.toml --trajectory flight.tum --outputs rgb,label --log run.mcap --coco truth.json
      fidsplat fly scene.toml --trajectory flight.tum --ray ray://HOST:10001       on a cluster
    """

    trajectory: str | None = None
    """FILE: poses of the camera (default: the scene's [[camera.motion]])"""
    out: str = DEFAULT_FOLDER
    """DIR|RUN.mcap: folder, or a log with its images in the folder RUN"""
    rate: float = 30.0
    """HZ: frames per second, also of the video"""
    times: str | None = None
    """T,T,...: times of frames in seconds, instead of --rate"""
    file_rate: float = 10.0
    """HZ: poses per second of a file without times"""
    smooth: bool = False
    """interpolate poses by smooth curves instead of straight lines"""
    video: str | None = None
    """FILE.mp4: also write a video of the first output (extra: video)"""
    log: str | None = None
    """FILE.mcap|BAG: also write a ROS 2 log of images, intrinsics and poses (extra: logs)"""
    coco: str | None = None
    """FILE.json: also write the markers in each image as COCO annotations"""
    bop: str | None = None
    """DIR: also write a scene of a BOP data set, e.g. dataset/train/000000 (outputs: rgb, depth, label)"""
    compress: Literal["jpeg", "png"] | None = None
    """jpeg|png: compress rgb in the log, as CompressedImage"""
    size: Size = None
    ray: str | None = None
    """ADDRESS: Ray cluster that renders: local, auto, ray://HOST:10001 (extra: ray)"""
    workers: int | None = None
    """N: workers of --ray (default: one per GPU, or one per machine)"""
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> int:
        from fidsplat.cameras.trajectory import check_rate
        from fidsplat.formats import load_trajectory
        from fidsplat.images.video import check_video
        from fidsplat.render.flight import Flight, FlightFolder
        from fidsplat.vision.coco import CocoAnnotations

        self.check()
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--workers must be at least 1, got {self.workers}")
        if self.workers is not None and self.ray is None:
            raise InputError(
                "--workers must be given with --ray ADDRESS, got --workers alone; add --ray local"
            )
        if self.out.endswith(".mcap"):
            self.log, self.out = self.log or self.out, self.out.removesuffix(".mcap")
        check_rate(self.rate)
        if self.video is not None:
            check_video(self.video)
        if self.coco is not None:
            writable_file(self.coco)
        path = None
        if self.trajectory is not None:
            path = load_trajectory(self.trajectory, self.file_rate, self.smooth)
        scene = self.load(size=self.size)
        if self.compress is not None:
            if self.log is None:
                raise InputError(f"--compress must be given with a log, got {self.compress}; add --log FILE")
            check_compressed(self.outputs or scene.outputs)
        path = path or _camera_motion(self.source, scene, self.smooth)
        times = (
            path.sampled(self.rate).times
            if self.times is None
            else parse_numbers("--times", self.times, "seconds")
        )
        flight = Flight(scene, path, times, scene.capture.with_(outputs=self.outputs, quality=self.quality))
        bop = None if self.bop is None else self._open_bop(self.bop, flight)
        with self._engine(flight) as (title, render):
            has_log = log_is_complete(self.log, self.overwrite, flight.key(title))
            folder = FlightFolder(self.out, flight, title, self.overwrite, self.source)
            begun = time.perf_counter()
            left = len(folder.remaining())
            list(show_progress("frames", render(folder), len(flight), len(flight) - left))
            seconds = time.perf_counter() - begun
        sheet = folder.write_sheet()
        if self.video is not None:
            list(show_progress("video", folder.write_video(self.video, self.rate), len(flight)))
        if self.log is not None and not has_log:
            frames = write_log(folder, self.log, self.overwrite, self.compress)
            list(show_progress("log", frames, len(flight)))
        if self.coco is not None:
            annotations = CocoAnnotations()
            frames = write_truth(folder, lambda file, _, truth: annotations.add(file, truth))
            list(show_progress("truth", frames, len(flight)))
            annotations.save(self.coco)
        if bop is not None:
            with bop:
                frames = write_truth(folder, lambda _, images, truth: bop.add(images, truth))
                list(show_progress("BOP", frames, len(flight)))
        return self._report(folder, sheet, left, seconds)

    @staticmethod
    def _open_bop(path: str, flight: Flight) -> BopScene:
        """The BOP scene to write; raises InputError for an unsupported camera or missing outputs."""
        from fidsplat.vision.bop import BopScene, check_bop_camera

        camera, outputs = flight.capture.camera, flight.capture.outputs
        if camera is not None:
            check_bop_camera(camera)
        if "rgb" not in outputs:
            raise InputError(f"--bop must have rgb among --outputs, got {','.join(outputs)}")
        return BopScene(path)

    @contextmanager
    def _engine(self, flight: Flight) -> Iterator[tuple[str, Callable[[FlightFolder], Iterator[int]]]]:
        """Title of the device or cluster, and a function that renders the missing frames of a folder."""
        from fidsplat.render.renderer import Renderer, default_device

        device = self.device or flight.scene.device or default_device()
        if self.ray is None:
            with console(self.json).status("opening the device"):
                renderer = Renderer(device, self.memory_budget)
            yield renderer.device.title, lambda folder: folder.render(renderer)
            return
        from fidsplat.remote.flights import FlightWork, render_flight
        from fidsplat.remote.ray_engine import ray_engine

        with ExitStack() as stack:
            with console(self.json).status("starting workers"):
                work = FlightWork(flight, device, self.memory_budget)
                engine = stack.enter_context(ray_engine(self.ray, work, self.workers))
            yield engine.title, lambda folder: render_flight(folder, engine, engine.workers)

    def _report(self, folder: FlightFolder, sheet: Path, rendered: int, seconds: float) -> int:
        frames = len(folder.flight)
        facts: dict[str, Any] = {"source": self.source, "device": folder.device, "frames": frames}
        facts |= {"rendered": rendered, "seconds": seconds, "folder": str(folder.folder)}
        facts |= {"contact_sheet": str(sheet), "video": self.video, "log": self.log, "coco": self.coco}
        facts["bop"] = self.bop
        earlier = f" ({frames - rendered} of an earlier run)" if rendered < frames else ""
        rate = f", {rendered / seconds:.1f} per second" if rendered else ""
        lines = [f"{frames} frames{earlier} on {folder.device} in {seconds:.1f} s{rate}", str(sheet)]
        files = (name for name in (self.video, self.log, self.coco, self.bop) if name is not None)
        return report(self.json, facts, *lines, *files)


def _camera_motion(source: str, scene: Scene, smooth: bool) -> Trajectory:
    """Camera-to-world poses of the scene's [[camera.motion]]."""
    from fidsplat.cameras import Trajectory

    if not isinstance(scene.camera_motion, Trajectory):
        raise InputError(
            f"{source} must have [[camera.motion]] to fly along, got none; or give --trajectory FILE"
        )
    inverse = scene.camera_motion.inverse()
    return Trajectory(inverse.times, inverse.poses, smooth)


def write_log(folder: FlightFolder, path: str, overwrite: bool, compress: str | None = None) -> Iterator[int]:
    """Write rgb, array outputs, intrinsics and poses to a log; yields the index of each frame."""
    from fidsplat.logs import RobotLog
    from fidsplat.scenes.up import scene_up

    flight = folder.flight
    camera = flight.capture.camera
    assert camera is not None
    start = min(0.0, float(flight.path.times[0]))  # the times of a log are not negative
    up = scene_up(flight.scene)
    with RobotLog(path, up=up, overwrite=overwrite, source=folder.key) as log:
        for k, (seconds, pose) in enumerate(zip(flight.path.times, flight.path.poses, strict=True)):
            moment = float(seconds) - start
            images = _load_images(folder, k)
            for name in {"rgb": None} | images:
                log.camera_info(moment, CAMERA, camera, name)
            for name, image in images.items():
                log.image(moment, CAMERA, image, name, compress if name == "rgb" else None)
            log.camera_pose(moment, CAMERA, pose)
            yield k


def write_truth(
    folder: FlightFolder, add: Callable[[str, Mapping[str, np.ndarray], Truth], object]
) -> Iterator[int]:
    """Call `add` with the file, images and ground truth of each frame; yields the frame's index."""
    from fidsplat.images.files import read_image
    from fidsplat.render.output_files import suffixes_of
    from fidsplat.vision.truth import truth_of

    flight = folder.flight
    for k, capture in enumerate(flight.captures):
        scene = replace(flight.scene, shutter=capture.shutter)
        assert capture.camera is not None
        camera = capture.motion.moved(capture.camera, capture.shutter.time)
        name = flight.capture.outputs[0]
        file = folder.file(k, name, suffixes_of(name)[-1])
        images = _load_images(folder, k) or {name: read_image(file)}
        add(str(file.relative_to(folder.folder)), images, truth_of(images, scene, camera))
        yield k


def _load_images(folder: FlightFolder, k: int) -> dict[str, np.ndarray]:
    """Lossless outputs of a frame: rgb, and outputs that are stored as arrays."""
    from fidsplat.images.files import read_image
    from fidsplat.render.output_files import load_output, suffixes_of

    images, camera = {}, folder.flight.capture.camera
    assert camera is not None
    for name in folder.flight.capture.outputs:
        if ".npy" in suffixes_of(name):
            images[name] = load_output(folder.file(k, name, ".npy"), (camera.height, camera.width))
        elif name == "rgb":
            images[name] = read_image(folder.file(k, name, ".png"))
    return images
