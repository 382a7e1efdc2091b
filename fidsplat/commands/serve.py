"""`fidsplat serve`."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from fidsplat.commands.declarations import option, switch
from fidsplat.commands.options import Json
from fidsplat.commands.output import console, report
from fidsplat.commands.scenes import RenderInput, Size
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.capture.lidar import Lidar
    from fidsplat.logs.live import LiveLog

CAMERA, LIDAR = "camera", "lidar"
"""names of frames and topics"""


@dataclass
class Serve(RenderInput):
    """Send live images, poses and LiDAR points of a scene as ROS 2 messages over a WebSocket.

    Open ws://127.0.0.1:8765 in Foxglove. The camera follows --trajectory or the scene's [[camera.motion]],
    again and again, or does not move. Topics are those of `fidsplat fly --log`: /camera/image_raw,
    /camera/camera_info, /tf, and with --lidar /lidar/points. Frames that would be late are dropped and
    counted. Ctrl-C ends it. Needs the extra `live`.

    Examples:
      fidsplat serve scene.toml
      fidsplat serve scene.toml --trajectory flight.tum --outputs rgb,depth --lidar vlp-16 --rate 10
    """

    trajectory: str | None = None
    """FILE: poses of the camera (default: the scene's [[camera.motion]])"""
    rate: Annotated[float, option("HZ", "frames and scans per second")] = 10.0
    file_rate: Annotated[float, option("HZ", "poses per second of a file without times")] = 10.0
    lidar: str | None = None
    """NAME: also scan with this sensor, at the camera; `fidsplat scan --help` lists them"""
    compress: Annotated[bool, switch("send rgb as JPEG, as CompressedImage")] = False
    foxglove: Annotated[bool, switch("use Foxglove's WebSocket protocol, which is the default")] = False
    host: str = "127.0.0.1"
    """ADDRESS: address to listen on; the default is this machine only, 0.0.0.0 opens it to the network"""
    port: int = 8765
    """N: port, 0 for any free one"""
    duration: float | None = None
    """S: seconds after which it ends (default: never)"""
    size: Size = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.cameras.trajectory import Trajectory, check_rate
        from fidsplat.formats import load_trajectory
        from fidsplat.logs.live import LiveLog
        from fidsplat.scenes.up import scene_up

        self.check()
        check_rate(self.rate)
        if self.duration is not None and not self.duration > 0:
            raise InputError(f"--duration must be a number of seconds above 0, got {self.duration:g}")
        lidar = None if self.lidar is None else fs.Lidar.preset(self.lidar)
        path = None
        if self.trajectory is not None:
            path = load_trajectory(self.trajectory, self.file_rate).inverse()
        scene = self.load(size=self.size)
        outputs = self.outputs or scene.outputs
        with console(self.json).status("opening the device"):
            renderer = fs.Renderer(self.device or scene.device, self.memory_budget)
            resident = renderer.upload(scene)
        motion = scene.motion if path is None else fs.Motion(path, scene.motion.groups)
        capture = scene.capture.with_(outputs=outputs, quality=self.quality, motion=motion)
        if capture.camera is None:
            raise InputError(f"{self.source} must have a [camera] to be served, got none")
        moving = motion.camera
        begin, length = 0.0, 0.0
        if isinstance(moving, Trajectory):
            begin, length = float(moving.times[0]), float(moving.times[-1] - moving.times[0])
        with LiveLog(self.host, self.port, up=scene_up(scene)) as log:
            shown = console(self.json)
            shown.print(f"ws://{self.host}:{log.port}")
            shown.file.flush()
            sender = _Sender(renderer, resident, capture, lidar, log, self.compress)
            clock = _Clock(self.rate, self.duration)
            try:
                for step, elapsed in clock:
                    sender.send(step, begin + (elapsed % length if length else elapsed))
            except KeyboardInterrupt:
                pass
        facts = {"frames": clock.sent, "dropped": clock.dropped, "seconds": clock.seconds, "port": log.port}
        rows = [("frames", f"{clock.sent:,}"), ("dropped", f"{clock.dropped:,}")]
        return report(self.json, facts, table=(f"{self.source} on {renderer.device.title}", ("", ""), rows))


@dataclass
class _Sender:
    """Renders and sends the messages of a moment."""

    renderer: Any
    resident: Any
    capture: Any
    lidar: Lidar | None
    log: LiveLog
    compress: bool

    def send(self, step: int, moment: float) -> None:
        """Send the images, the pose and the points at a moment of the scene's clock."""
        import fidsplat as fs
        from fidsplat.render.scan import LINK_FROM_OPTICAL

        capture, now = self.capture, time.time()
        capture = capture.with_(shutter=replace(capture.shutter, time=moment))
        frame = self.renderer.render(self.resident, capture)
        camera = capture.motion.moved(capture.camera, moment)
        for name in capture.outputs:
            self.log.camera_info(now, CAMERA, camera, name)
            self.log.image(
                now, CAMERA, frame[name], name, "jpeg" if self.compress and name == "rgb" else None
            )
        self.log.camera_pose(now, CAMERA, camera.camera_to_world)
        if self.lidar is not None:
            pose = camera.camera_to_world @ np.linalg.inv(LINK_FROM_OPTICAL)
            still = fs.Motion(None, capture.motion.groups)
            scan = fs.scan(
                self.resident,
                self.lidar,
                pose,
                renderer=self.renderer,
                motion=still,
                start=moment,
                index=step,
            )
            self.log.transform(now, LIDAR, pose)
            self.log.points(now, LIDAR, scan.cloud())


class _Clock:
    """Steps at a rate: a step whose time has passed by a period is dropped."""

    def __init__(self, rate: float, duration: float | None) -> None:
        self._rate, self._duration = rate, duration
        self.sent, self.dropped, self.seconds = 0, 0, 0.0

    def __iter__(self):
        start, step = time.monotonic(), 0
        while self._duration is None or step / self._rate < self._duration:
            wait = start + step / self._rate - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            yield step, step / self._rate
            self.sent += 1
            self.seconds = time.monotonic() - start
            due = max(step + 1, int(self.seconds * self._rate))
            self.dropped += due - step - 1
            step = due
