"""RobotLog: images, poses and detections as ROS 2 messages."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from typing import Any, Self

import numpy as np

from fidsplat.cameras import BrownConrady, Camera, Fisheye
from fidsplat.cameras.foreign import LINK_FROM_OPTICAL, PIXEL_OFFSET, opencv_matrix
from fidsplat.effects import IMAGES
from fidsplat.images.files import encode_image, pixels_of, to_uint8
from fidsplat.logs.reader import SCENE
from fidsplat.logs.writers import LogFile, log_file, typestore
from fidsplat.splats.rotations import check_similarity, matrix_to_quaternion, pose_matrix
from fidsplat.util.arguments import (
    direction,
    instance,
    invalid,
    items,
    number,
    real_array,
    text,
    three_numbers,
)
from fidsplat.util.errors import InputError, os_errors, unknown
from fidsplat.vision.detect import Detection

_POINT_FIELDS = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""datatypes of sensor_msgs/PointField"""


class RobotLog:
    """Writer of a log, NAME.mcap or a rosbag2 folder (SQLite), message by message; a context manager.

    Times are in seconds and must not decrease within a topic. The log is created when the block ends without
    an error.

    Args:
        path: NAME.mcap, or a new folder.
        world: name of the reference frame of poses.
        up: (3,) direction that points up in the scene. With it, frames follow REP-103 and REP-105: the z axis
            of the world points up, the scene's own axes are the frame `scene`, and data of a camera have the
            frame CAMERA_optical_frame, for which `camera_pose` writes the poses.
        overwrite: whether an existing log is replaced.
        source: identifies the source of the log in its metadata, so that `check_log` recognises it.

    Raises:
        InputError: the log exists, cannot be written, or the packages are missing (extra `logs`).
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        world: str = "map",
        up: Any = None,
        overwrite: bool = False,
        source: str = "",
    ) -> None:
        self._begin(world, up)
        self._path: Any = path
        self._file: LogFile = log_file(path, self._store, overwrite, source)

    def _begin(self, world: str, up: Any) -> None:
        """Set the fields that do not depend on the destination of the messages."""
        self.world_from_scene: Any = None if up is None else _upright(up)
        """rotation (4, 4) of the scene in the world; None without `up`"""
        self._store, self.world = typestore(), world
        self._last: dict[str, float] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type | None, *_: Any) -> None:
        with os_errors(f"cannot write {self._path}"):
            self._file.close(kind is None)

    def image(
        self, time: float, camera: str, image: np.ndarray, output: str = "rgb", compress: str | None = None
    ) -> None:
        """Write an output image as `/CAMERA/image_raw`, or `/CAMERA/OUTPUT/image_raw` for outputs other than
        rgb: rgb8, 32FC1, 32FC3 or 32SC1.

        compress: "jpeg" or "png" writes rgb as `/CAMERA/image_raw/compressed` instead.

        Raises:
            InputError: a time before the last, an unknown compression.
        """
        text("output", output)
        pixels = pixels_of(image)
        if pixels.ndim not in (2, 3) or not pixels.size or (output == "rgb" and pixels.shape[2:] != (3,)):
            raise InputError(f"an image must be (h, w) or (h, w, k), rgb (h, w, 3), got {pixels.shape}")
        topic = f"{_namespace(camera, output)}/image_raw"
        if compress is not None:
            if not isinstance(compress, str) or compress not in ("jpeg", "png") or output != "rgb":
                raise InputError(
                    f"compress must be 'jpeg' or 'png', for rgb only, got {compress!r} for {output}"
                )
            data = np.frombuffer(encode_image(pixels, compress), np.uint8)
            message = self._of("sensor_msgs/msg/CompressedImage")(
                self._header(time, self._frame(camera)), compress, data
            )
            self._write(f"{topic}/compressed", time, message)
            return
        pixels = to_uint8(pixels) if output == "rgb" else pixels
        kind = _encoding(output, 1 if pixels.ndim == 2 else pixels.shape[2])
        dtype = np.uint8 if kind == "rgb8" else np.int32 if kind == "32SC1" else np.float32
        with np.errstate(over="ignore"):
            pixels = np.ascontiguousarray(pixels, dtype)
        height, width = pixels.shape[:2]
        data = pixels.reshape(-1).view(np.uint8)
        self._write(
            topic,
            time,
            self._of("sensor_msgs/msg/Image")(
                self._header(time, self._frame(camera)), height, width, kind, 0, data.size // height, data
            ),
        )

    def camera_info(self, time: float, name: str, camera: Camera, output: str = "rgb") -> None:
        """Write a camera's intrinsics and distortion as `/CAMERA/camera_info`, or
        `/CAMERA/OUTPUT/camera_info` for outputs other than rgb: plumb_bob, rational_polynomial or
        equidistant.

        Raises:
            InputError: a lens without a ROS model.
        """
        model, factors = _distortion(instance("camera", camera, Camera))
        k = opencv_matrix(camera)
        roi = self._of("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        message = self._of("sensor_msgs/msg/CameraInfo")(
            self._header(time, self._frame(name)), camera.height, camera.width, model,
            np.array(factors, np.float64), k.ravel(), np.eye(3).ravel(),
            np.column_stack([k, np.zeros(3)]).ravel(), 0, 0, roi,
        )  # fmt: skip
        self._write(f"{_namespace(name, output)}/camera_info", time, message)

    def camera_pose(self, time: float, camera: str, pose: Any, base: Any = None) -> None:
        """Write the pose of a camera in the scene (4, 4), with OpenCV's axes, as `/tf`.

        If the log has `up`, three transforms are written: world to scene, world to CAMERA_link (x forward,
        z up), and CAMERA_link to CAMERA_optical_frame. Otherwise one: world to CAMERA.

        base: pose in the world (4, 4) of the robot that carries the camera. With it, CAMERA_link is relative
        to the frame base_link.
        """
        if self.world_from_scene is None:
            return self.transform(time, camera, pose)
        in_scene = _rigid(pose, f"the pose of {text('the name of a frame', camera)}")
        link, parent = self.world_from_scene @ in_scene @ np.linalg.inv(LINK_FROM_OPTICAL), self.world
        transforms = [(self.world, SCENE, self.world_from_scene)]
        if base is not None:
            carrier, parent = _rigid(base, "the pose of base_link"), "base_link"
            transforms.append((self.world, parent, carrier))
            link = np.linalg.inv(carrier) @ link
        transforms += [
            (parent, f"{camera}_link", link),
            (f"{camera}_link", self._frame(camera), LINK_FROM_OPTICAL),
        ]
        self._transforms(time, *transforms)

    def clock(self, time: float) -> None:
        """Write the time as `/clock`, for nodes with `use_sim_time`."""
        self._write("/clock", time, self._of("rosgraph_msgs/msg/Clock")(self._stamp(time)))

    def transform(self, time: float, frame: str, pose: Any, parent: str | None = None) -> None:
        """Write the pose of a frame in its parent (4, 4), by default the world, as `/tf`. A camera's frame
        has OpenCV's axes, like ROS's optical frames."""
        checked = _rigid(pose, f"the pose of {text('the name of a frame', frame)}")
        self._transforms(
            time, (self.world, frame, self._in_world(checked)) if parent is None else (parent, frame, checked)
        )

    def odometry(
        self, time: float, pose: Any, velocity: Any = (0, 0, 0), angular_velocity: Any = (0, 0, 0),
        frame: str = "base_link", topic: str = "/odom", covariance: Any = None,
    ) -> None:  # fmt: skip
        """Write the odometry of a body: pose in the world (4, 4), velocities (3,) in m/s and rad/s in the
        body's axes, and covariance of the pose (6, 6)."""
        position, rotation = self._pose_parts(self._in_world(_rigid(pose, "the pose of odometry")))
        spread = np.zeros((6, 6)) if covariance is None else real_array("covariance", covariance)
        if spread.shape != (6, 6):
            raise invalid("covariance", "(6, 6) numbers", covariance)
        text("frame", frame)
        vector, point = self._of("geometry_msgs/msg/Vector3"), self._of("geometry_msgs/msg/Point")
        body = self._of("geometry_msgs/msg/Pose")(point(*position), rotation)
        twist = self._of("geometry_msgs/msg/Twist")(
            vector(*three_numbers("velocity", velocity)),
            vector(*three_numbers("angular_velocity", angular_velocity)),
        )
        message = self._of("nav_msgs/msg/Odometry")(
            self._header(time, self.world),
            frame,
            self._of("geometry_msgs/msg/PoseWithCovariance")(body, spread.ravel()),
            self._of("geometry_msgs/msg/TwistWithCovariance")(twist, np.zeros(36)),
        )
        self._write(topic, time, message)

    def imu(
        self,
        time: float,
        angular_velocity: Any,
        acceleration: Any = None,
        frame: str = "imu_link",
        topic: str = "/imu/data_raw",
    ) -> None:
        """Write an IMU message without orientation, named by REP-145. Angular velocity (3,) is in rad/s,
        acceleration (3,) in m/s^2; None: not measured."""
        vector, none = self._of("geometry_msgs/msg/Vector3"), np.zeros(9)
        unknown = np.array([-1.0, *np.zeros(8)])  # ROS's value for a missing reading
        message = self._of("sensor_msgs/msg/Imu")(
            self._header(time, frame), self._of("geometry_msgs/msg/Quaternion")(0.0, 0.0, 0.0, 1.0),
            unknown, vector(*three_numbers("angular_velocity", angular_velocity)), none,
            vector(*three_numbers("acceleration", (0, 0, 0) if acceleration is None else acceleration)),
            unknown if acceleration is None else none,
        )  # fmt: skip
        self._write(topic, time, message)

    def joint_states(
        self, time: float, names: Iterable[str], positions: Any, topic: str = "/joint_states"
    ) -> None:
        """Write positions of joints: radians, or metres for prismatic joints."""
        named = list(items("names", names, str, "names of joints"))
        values = real_array("positions", positions, "a number for each joint")
        if values.shape != (len(named),) or not np.isfinite(values).all():
            raise invalid("positions", f"{len(named)} finite numbers", positions)
        message = self._of("sensor_msgs/msg/JointState")
        self._write(topic, time, message(self._header(time, ""), named, values, np.zeros(0), np.zeros(0)))

    def points(self, time: float, lidar: str, cloud: np.ndarray, topic: str | None = None) -> None:
        """Write the points of a scan (`Scan.cloud`) as `/LIDAR/points`: PointCloud2 in the frame LIDAR.
        `time` is the start of the scan; the field `time` of a point is in seconds after it.

        Raises:
            InputError: not a structured array of numbers.
        """
        names = getattr(getattr(cloud, "dtype", None), "names", None)
        if names is None or cloud.ndim != 1:
            raise invalid("the points of a scan", "a structured array (n,), as of Scan.cloud()", cloud)
        field_type = self._of("sensor_msgs/msg/PointField")
        little = np.dtype([(name, cloud.dtype[name].newbyteorder("<")) for name in names])
        fields = []
        for name in names:
            code = little[name].str[1:]
            if code not in _POINT_FIELDS:
                raise invalid(f"the field {name} of points", f"one of {', '.join(_POINT_FIELDS)}", code)
            fields.append(field_type(name, little.fields[name][1], _POINT_FIELDS[code], 1))  # type: ignore[index]
        data = np.frombuffer(cloud.astype(little).tobytes(), np.uint8)
        message = self._of("sensor_msgs/msg/PointCloud2")(
            self._header(time, lidar), 1, len(cloud), fields, False, little.itemsize, data.size, data, True
        )
        self._write(f"/{lidar}/points" if topic is None else topic, time, message)

    def detections(self, time: float, camera: str, found: Iterable[Detection]) -> None:
        """Write the detections in an image as `/CAMERA/detections` (apriltag_msgs); the family of a QR code
        is its payload."""
        point, tag = (self._of(f"apriltag_msgs/msg/{name}") for name in ("Point", "AprilTagDetection"))
        tags = []
        for code in items("found", found, Detection, "a list of Detection"):
            corners = [point(float(x), float(y)) for x, y in np.asarray(code.corners) - PIXEL_OFFSET]
            middle = point(*(np.asarray(code.corners).mean(0) - PIXEL_OFFSET).tolist())
            family, number = (code.payload or "", -1) if code.id is None else (code.family or "", code.id)
            tags.append(tag(family, number, 0, 0.0, 0.0, middle, corners, np.zeros(9)))
        message = self._of("apriltag_msgs/msg/AprilTagDetectionArray")(
            self._header(time, self._frame(camera)), tags
        )
        self._write(f"/{camera}/detections", time, message)

    def _of(self, kind: str) -> Any:
        return self._store.types[kind]

    def _header(self, time: float, frame: str) -> Any:
        text("the name of a frame", frame)
        return self._of("std_msgs/msg/Header")(self._stamp(time), frame)

    def _stamp(self, time: float) -> Any:
        return self._of("builtin_interfaces/msg/Time")(*divmod(_nanoseconds(time), 10**9))

    def _frame(self, camera: str) -> str:
        """The frame of a camera's data."""
        text("the name of a frame", camera)
        return camera if self.world_from_scene is None else f"{camera}_optical_frame"

    def _in_world(self, pose: np.ndarray) -> np.ndarray:
        """A pose in the scene as a pose in the world."""
        return pose if self.world_from_scene is None else self.world_from_scene @ pose

    def _transforms(self, time: float, *transforms: tuple[str, str, np.ndarray]) -> None:
        """Write one `/tf` message of parents, frames and poses."""
        stamped = []
        for parent, frame, pose in transforms:
            position, rotation = self._pose_parts(pose)
            transform = self._of("geometry_msgs/msg/Transform")(
                self._of("geometry_msgs/msg/Vector3")(*position), rotation
            )
            stamped.append(
                self._of("geometry_msgs/msg/TransformStamped")(self._header(time, parent), frame, transform)
            )
        self._write("/tf", time, self._of("tf2_msgs/msg/TFMessage")(stamped))

    def _pose_parts(self, pose: np.ndarray) -> tuple[list[float], Any]:
        w, x, y, z = matrix_to_quaternion(pose[:3, :3]).tolist()
        return pose[:3, 3].tolist(), self._of("geometry_msgs/msg/Quaternion")(x, y, z, w)

    def _write(self, topic: str, time: float, message: Any) -> None:
        text("topic", topic)
        if time < self._last.get(topic, -math.inf):
            raise InputError(
                f"the time of {topic} must be at least {self._last[topic]:g} s, got {time:g} s; a simulator "
                "that was reset needs a new log"
            )
        self._last[topic] = time
        kind = message.__msgtype__
        data = bytes(self._store.serialize_cdr(message, kind))
        with os_errors(f"cannot write {self._path}"):
            self._file.write(topic, kind, _nanoseconds(time), data)


def _namespace(camera: str, output: str) -> str:
    return f"/{camera}" if output == "rgb" else f"/{camera}/{text('output', output)}"


def _upright(up: Any) -> np.ndarray:
    """The smallest rotation (4, 4) that maps a direction to the z axis."""
    x, y, z = direction("up", up)
    pose = np.eye(4)
    if z < -1 + 1e-12:  # half a turn about x
        pose[:3, :3] = np.diag([1, -1, -1])
    else:
        cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
        pose[:3, :3] += cross + cross @ cross / (1 + z)
    return pose


def _encoding(output: str, channels: int) -> str:
    """ROS image encoding of an output."""
    if output == "rgb":
        return "rgb8"
    declared = IMAGES.get(output)
    return "32SC1" if declared is not None and declared.dtype == "int32" else f"32FC{channels}"


def _nanoseconds(time: float) -> int:
    return round(number("a log's time", time, "seconds from 0 to 2^31", 0.0, 2**31 - 1) * 1e9)


def _rigid(pose: Any, name: str) -> np.ndarray:
    """A rigid matrix (4, 4) or pair as float64. Raises InputError."""
    matrix = pose_matrix(pose, name)
    check_similarity(matrix, name, rigid=True)
    return np.asarray(matrix, np.float64)


def _distortion(camera: Camera) -> tuple[str, list[float]]:
    lens = camera.lens
    if lens is None:
        return "plumb_bob", [0.0] * 5
    if isinstance(lens, Fisheye):
        return "equidistant", [lens.k1, lens.k2, lens.k3, lens.k4]
    if isinstance(lens, BrownConrady):
        first = [lens.k1, lens.k2, lens.p1, lens.p2, lens.k3]
        prism = [lens.s1, lens.s2, lens.s3, lens.s4]
        rational = [lens.k4, lens.k5, lens.k6]
        if any(prism):
            return "rational_polynomial", first + rational + prism
        return ("rational_polynomial", first + rational) if any(rational) else ("plumb_bob", first)
    raise InputError(unknown("lens of ROS's CameraInfo", lens.kind, ("brown_conrady", "fisheye")))
