"""Command `fidsplat serve`: send images, poses and LiDAR points of a scene as ROS 2 messages."""

from __future__ import annotations

import math
import time
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from fidsplat.cameras.foreign import LINK_FROM_OPTICAL
from fidsplat.cameras.screw import exponential
from fidsplat.commands.options import Json, check_compressed, require_packages
from fidsplat.commands.output import console, report
from fidsplat.commands.scenes import RenderInput, Size
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util import interrupts
from fidsplat.util.arguments import number
from fidsplat.util.errors import InputError

if TYPE_CHECKING:
    from fidsplat.cameras import Camera
    from fidsplat.capture.lidar import Lidar
    from fidsplat.logs.live import LiveLog

CAMERA, LIDAR = "camera", "lidar"
"""names of the frames and topics"""
TIMEOUT = 0.5
"""seconds without a new /cmd_vel after which the robot stops"""
FAR = 1e9
"""largest coordinate of the robot in metres; poses of other programs beyond it are ignored"""


@dataclass
class Serve(RenderInput):
    """Send live images, poses and LiDAR points of a scene as ROS 2 messages.

    Without options, open ws://127.0.0.1:8765 in Foxglove. --ros2 publishes ROS 2 topics, by rclpy if it is
    installed, else by Cyclone DDS; nodes need ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST. The camera repeats
    --trajectory or the scene's [[camera.motion]]. Without these it is static; with --ros2, /cmd_vel (Twist)
    and /pose (PoseStamped in the frame map, scene or base_link) move its robot. Topics: /camera/image_raw,
    /camera/camera_info, /tf, /clock, and with --lidar /lidar/points. Late frames are dropped and counted.
    Ctrl-C ends it. Needs the extra `live`.

    Examples:
      fidsplat serve scene.toml
      fidsplat serve scene.toml --ros2 --compress --rate 20
      fidsplat serve scene.toml --trajectory flight.tum --outputs rgb,depth --lidar vlp-16 --rate 10
    """

    trajectory: str | None = None
    """FILE: poses of the camera (default: the scene's [[camera.motion]])"""
    rate: float = 10.0
    """HZ: frames and scans per second"""
    file_rate: float = 10.0
    """HZ: poses per second of a file without times"""
    lidar: str | None = None
    """NAME: also scan with this sensor, at the camera; `fidsplat scan --help` lists them"""
    compress: bool = False
    """send rgb as JPEG, as CompressedImage"""
    ros2: bool = False
    """publish ROS 2 topics, in the domain ROS_DOMAIN_ID"""
    foxglove: bool = False
    """serve Foxglove's WebSocket protocol; the default without --ros2"""
    host: str = "127.0.0.1"
    """ADDRESS: address to listen on; the default is this machine only, 0.0.0.0 opens it to the network"""
    port: int = 8765
    """N: port of Foxglove's protocol; 0 for any free port"""
    duration: float | None = None
    """S: seconds after which the server ends (default: never)"""
    size: Size = None
    json: Json = False

    def run(self) -> int:
        import fidsplat as fs
        from fidsplat.cameras.trajectory import Trajectory
        from fidsplat.formats import load_trajectory
        from fidsplat.scenes.up import scene_up

        self.check()
        number("--rate", self.rate, "a number of frames per second, 0.001 to 1000", 1e-3, 1e3)
        foxglove = self.foxglove or not self.ros2
        packages = ["rosbags", "mcap"] + ["foxglove"] * foxglove
        if self.ros2 and find_spec("rclpy") is None:
            packages.append("cyclonedds")
        require_packages("fidsplat serve", packages, "live")
        from fidsplat.logs.live import LiveLog

        if self.duration is not None and not self.duration > 0:
            raise InputError(f"--duration must be a number of seconds above 0, got {self.duration:g}")
        lidar = None if self.lidar is None else fs.Lidar.preset(self.lidar)
        path = None
        if self.trajectory is not None:
            path = load_trajectory(self.trajectory, self.file_rate).inverse()
        scene = self.load(size=self.size)
        outputs = self.outputs or scene.outputs
        if self.compress:
            check_compressed(outputs)
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
        port = self.port if foxglove else None
        with LiveLog(self.host, port, ros2=self.ros2, up=scene_up(scene)) as log:
            shown = console(self.json)
            shown.print("ROS 2 topics" if port is None else f"ws://{self.host}:{log.port}")
            shown.file.flush()
            driver = _Driver(log, capture.camera) if self.ros2 and moving is None else None
            sender = _Sender(renderer, resident, capture, lidar, log, self.compress, driver)
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
    """Sender of the rendered messages of one time."""

    renderer: Any
    resident: Any
    capture: Any
    lidar: Lidar | None
    log: LiveLog
    compress: bool
    driver: _Driver | None

    def send(self, step: int, moment: float) -> None:
        """Send images, pose and points at a time of the scene in seconds."""
        import fidsplat as fs

        capture, now = self.capture, time.time()
        capture = capture.with_(shutter=replace(capture.shutter, time=moment))
        base = None
        if self.driver is not None:
            base = self.driver.base_at(moment)
            capture = capture.with_(camera=self.driver.camera(capture.camera))
        frame = self.renderer.render(self.resident, capture)
        camera = capture.motion.moved(capture.camera, moment)
        self.log.clock(now)
        for name in capture.outputs:
            self.log.camera_info(now, CAMERA, camera, name)
            self.log.image(
                now, CAMERA, frame[name], name, "jpeg" if self.compress and name == "rgb" else None
            )
        self.log.camera_pose(now, CAMERA, camera.camera_to_world, base)
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


class _Driver:
    """Robot that ROS 2's /cmd_vel and /pose move. Its frame base_link is at the camera, upright."""

    def __init__(self, log: LiveLog, camera: Camera) -> None:
        self._log, self._twist, self._time, self._until = log, np.zeros(6), 0.0, 0.0
        there = log.world_from_scene @ camera.camera_to_world
        half = math.atan2(there[1, 2], there[0, 2]) / 2
        self._base = rigid_matrix(there[:3, 3], (math.cos(half), 0, 0, math.sin(half)))
        self._mount = np.linalg.inv(self._base) @ there

    def base_at(self, time: float) -> np.ndarray:
        """Pose of base_link in the world (4, 4) at a time; times must not decrease."""
        from fidsplat.logs.reader import SCENE

        self._place(self._base @ exponential(self._twist * max(0.0, min(time, self._until) - self._time)))
        self._time = time
        for stamped in self._log.received("/pose", "geometry_msgs/msg/PoseStamped"):
            at, rotation = stamped.pose.position, stamped.pose.orientation
            frames = {self._log.world: np.eye(4), SCENE: self._log.world_from_scene, "base_link": self._base}
            # a wrong frame or an invalid pose from another program must not end the server
            with suppress(InputError, KeyError):
                frame = frames[stamped.header.frame_id or self._log.world]
                self._place(
                    frame @ rigid_matrix((at.x, at.y, at.z), (rotation.w, rotation.x, rotation.y, rotation.z))
                )
        for twist in self._log.received("/cmd_vel", "geometry_msgs/msg/Twist"):
            parts = [getattr(part, axis) for part in (twist.angular, twist.linear) for axis in "xyz"]
            self._twist, self._until = np.array(parts), time + TIMEOUT
        return self._base

    def _place(self, pose: np.ndarray) -> None:
        """Move base_link to a pose; ignored if the pose is not finite or farther away than `FAR`."""
        if (np.abs(pose) <= FAR).all():
            self._base = pose

    def camera(self, camera: Camera) -> Camera:
        """The camera at the current pose of the robot."""
        pose = np.linalg.inv(self._log.world_from_scene) @ self._base @ self._mount
        return camera.with_pose(camera_to_world=pose)


class _Clock:
    """Steps at a fixed rate; a step that is late by a period or more is dropped."""

    def __init__(self, rate: float, duration: float | None) -> None:
        self._rate, self._duration = rate, duration
        self.sent, self.dropped, self.seconds = 0, 0, 0.0

    def __iter__(self):
        start, step = time.monotonic(), 0
        while self._duration is None or step / self._rate < self._duration:
            wait = start + step / self._rate - time.monotonic()
            if wait > 0:
                interrupts.sleep(wait)
            yield step, step / self._rate
            if not self.sent:  # the first frame compiles kernels
                start = time.monotonic()
            self.sent += 1
            self.seconds = time.monotonic() - start
            due = max(step + 1, int(self.seconds * self._rate))
            self.dropped += due - step - 1
            step = due
