"""Live messages, read by clients with Foxglove's protocol and ROS 2's CDR, and by a DDS participant with
its own types."""

import json
import os
import struct
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands.serve import _Clock

pytest.importorskip("foxglove", reason="pip install 'fidsplat[live]'")
pytest.importorskip("rosbags", reason="pip install 'fidsplat[logs]'")
pytest.importorskip("cyclonedds", reason="pip install 'fidsplat[live]'")
websockets = pytest.importorskip("websockets.sync.client", reason="the client of this test")
from cyclonedds.domain import Domain, DomainParticipant  # noqa: E402
from cyclonedds.idl import IdlStruct  # noqa: E402
from cyclonedds.idl import types as dds  # noqa: E402
from cyclonedds.pub import DataWriter  # noqa: E402
from cyclonedds.qos import Policy, Qos  # noqa: E402
from cyclonedds.sub import DataReader  # noqa: E402
from cyclonedds.topic import Topic  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

SCENE = """[camera]
width = 64
height = 48
fx = 60.0
fy = 50.0
cx = 30.0
cy = 25.0
position = [0.1, 0.0, -2.0]
look_at = [0.0, 0.0, 0.0]
[[markers]]
spec = "apriltag:36h11:5"
size = 1.0
[render]
background = [0.2, 0.5, 0.8]
"""


def subscribed(port: int, wanted: set[str]) -> list[tuple[str, str, int, bytes]]:
    """(topic, type, nanoseconds, CDR) of messages, until every topic has one."""
    results = []
    with websockets.connect(
        f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=2**24
    ) as server:
        channels: dict[int, dict] = {}
        while {topic for topic, *_ in results} != wanted and len(results) < 200:
            message = server.recv(timeout=60)
            if isinstance(message, str):
                printed = json.loads(message)
                for channel in printed.get("channels", ()):
                    if channel["topic"] in wanted:
                        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                        channels[channel["id"]] = channel
                news = {channel["id"] for channel in printed.get("channels", ())}
                if printed["op"] == "status":
                    # the server may refuse a channel that it has just announced; then it is requested again
                    time.sleep(0.2)
                    heard = {topic for topic, *_ in results}
                    news = {number for number, one in channels.items() if one["topic"] not in heard}
                for number in news & set(channels):
                    one = {"id": number, "channelId": number}
                    server.send(json.dumps({"op": "subscribe", "subscriptions": [one]}))
            elif message[0] == 1:
                number, stamp = struct.unpack_from("<IQ", message, 1)
                channel = channels[number]
                results.append((channel["topic"], channel["schemaName"], stamp, message[13:]))
    return results


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Port of Foxglove's protocol, and domain of ROS 2, of a server in another process."""
    file = tmp_path_factory.mktemp("served") / "scene.toml"
    file.write_text(SCENE)
    domain = str(1 + os.getpid() % 200)
    options = ("--port", "0", "--lidar", "vlp-16", "--rate", "10", "--duration", "60", "--json")
    command = [sys.executable, "-m", "fidsplat", "serve", str(file), "--foxglove", "--ros2", *options]
    quiet = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    environment = os.environ | {"COLUMNS": "200", "ROS_DOMAIN_ID": domain}
    with subprocess.Popen(command, **quiet, env=environment) as server:
        try:
            line = ""
            while "ws://" not in line:
                line = server.stderr.readline()
                assert line, "the server ended"
            yield file, int(line.rsplit(":", 1)[1]), int(domain)
        finally:
            server.terminate()


def test_a_client_receives_images_poses_and_points(served):
    from rosbags.typesys import Stores, get_typestore

    file, port, _ = served
    topics = {"/camera/image_raw", "/camera/camera_info", "/tf", "/lidar/points"}
    messages = subscribed(port, topics)
    store = get_typestore(Stores.ROS2_HUMBLE)
    read = {}
    for topic, kind, stamp, data in messages:
        read.setdefault(topic, []).append((store.deserialize_cdr(data, kind), stamp))
    assert set(read) == topics
    image, stamp = read["/camera/image_raw"][0]
    pixels = np.frombuffer(image.data.tobytes(), np.uint8).reshape(48, 64, 3)
    expected = fs.Renderer().render(fs.Scene.load(file))["rgb"]
    np.testing.assert_allclose(pixels / 255, np.clip(expected, 0, 1), atol=0.5 / 255 + 1e-6)
    assert (image.encoding, image.header.frame_id) == ("rgb8", "camera_optical_frame")
    assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == stamp
    info, _ = read["/camera/camera_info"][0]
    assert info.k.tolist() == [60, 0, 29.5, 0, 50, 24.5, 0, 0, 1]
    points, _ = read["/lidar/points"][0]
    # x forward: the tag is a plane 2 m in front
    x = np.frombuffer(points.data.tobytes(), np.uint8).reshape(points.width, points.point_step)[:, :4]
    assert points.width > 50
    assert np.abs(np.median(np.ascontiguousarray(x).view("<f4")) - 2.0) < 0.1
    frames = {one.child_frame_id for message, _ in read["/tf"] for one in message.transforms}
    assert {"camera_link", "camera_optical_frame"} <= frames


@dataclass
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: dds.int32
    nanosec: dds.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header
    height: dds.uint32
    width: dds.uint32
    encoding: str
    is_bigendian: dds.uint8
    step: dds.uint32
    data: dds.sequence[dds.uint8]


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: dds.float64
    y: dds.float64
    z: dds.float64


@dataclass
class Point(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: dds.float64
    y: dds.float64
    z: dds.float64


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: dds.float64
    y: dds.float64
    z: dds.float64
    w: dds.float64


@dataclass
class Twist(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3
    angular: Vector3


@dataclass
class Pose(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class Transform(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: dds.sequence[TransformStamped]


@dataclass
class Clock(IdlStruct, typename="rosgraph_msgs.msg.dds_.Clock_"):
    clock: Time


LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>
<Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


def test_a_ros2_node_receives_and_drives(served):
    """Names, types and frames of topics, read by another participant, which then places and drives the
    robot."""
    file, _, number = served
    domain = Domain(number, LOOPBACK)
    node = DomainParticipant(number)
    reliable = Qos(Policy.Reliability.Reliable(10**9), Policy.History.KeepLast(10))
    images, transforms, clocks = (
        DataReader(node, Topic(node, name, kind), reliable)
        for name, kind in (("rt/camera/image_raw", Image), ("rt/tf", TFMessage), ("rt/clock", Clock))
    )
    drive, place = (
        DataWriter(node, Topic(node, name, kind), reliable)
        for name, kind in (("rt/cmd_vel", Twist), ("rt/pose", PoseStamped))
    )

    def next_of(reader, wanted=lambda message: True):
        until = time.monotonic() + 30
        while time.monotonic() < until:
            for message in reader.take(20):
                if wanted(message):
                    return message
            time.sleep(0.01)
        raise AssertionError("no such message")

    def base(message):
        """Matrix of map to base_link, in the message of the camera."""
        by_frame = {one.child_frame_id: one for one in message.transforms}
        if "base_link" not in by_frame:
            return None
        assert {name: one.header.frame_id for name, one in by_frame.items()} == {
            "scene": "map", "base_link": "map", "camera_link": "base_link",
            "camera_optical_frame": "camera_link",
        }  # fmt: skip
        at, rotation = by_frame["base_link"].transform.translation, by_frame["base_link"].transform.rotation
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w]).as_matrix()
        matrix[:3, 3] = at.x, at.y, at.z
        return matrix

    until = time.monotonic() + 30
    while not (drive.get_matched_subscriptions() and place.get_matched_subscriptions()):
        assert time.monotonic() < until, "nobody subscribes to /cmd_vel and /pose"
        time.sleep(0.01)
    image = next_of(images)
    expected = fs.Renderer().render(fs.Scene.load(file))["rgb"]
    pixels = np.array(image.data, np.uint8).reshape(48, 64, 3)
    np.testing.assert_allclose(pixels / 255, np.clip(expected, 0, 1), atol=0.5 / 255 + 1e-6)
    assert (image.encoding, image.step, image.header.frame_id) == ("rgb8", 192, "camera_optical_frame")
    assert abs(next_of(clocks).clock.sec - time.time()) < 5
    stands = base(next_of(transforms, lambda message: base(message) is not None))

    here = stands.copy()
    here[:3, 3] += 0.5 * stands[:3, 0]  # half a metre forward
    quaternion = Rotation.from_matrix(here[:3, :3]).as_quat()
    stamped = PoseStamped(Header(Time(0, 0), "map"), Pose(Point(*here[:3, 3]), Quaternion(*quaternion)))
    place.write(stamped)
    moved = next_of(transforms, lambda m: (b := base(m)) is not None and not np.allclose(b, stands))
    np.testing.assert_allclose(base(moved), here, atol=1e-9)
    stamp = moved.transforms[0].header.stamp
    image = next_of(
        images, lambda one: (one.header.stamp.sec, one.header.stamp.nanosec) == (stamp.sec, stamp.nanosec)
    )
    pixels = np.array(image.data, np.uint8).reshape(48, 64, 3)
    camera = fs.Scene.load(file).camera
    nearer = camera.camera_to_world
    nearer[:3, 3] += 0.5 * nearer[:3, 2] * [1, 0, 1] / np.linalg.norm(nearer[[0, 2], 2])
    expected = fs.Renderer().render(fs.Scene.load(file), camera.with_pose(camera_to_world=nearer))["rgb"]
    np.testing.assert_allclose(pixels / 255, np.clip(expected, 0, 1), atol=0.5 / 255 + 1e-5)

    for frame, x in (("map", np.nan), ("map", 1e30), ("lidar", 9.0)):  # ignored
        place.write(PoseStamped(Header(Time(0, 0), frame), Pose(Point(x, 0.0, 0.0), Quaternion(*quaternion))))
    # a step of 0.1 m forward from where it stands
    place.write(PoseStamped(Header(Time(0, 0), "base_link"), Pose(Point(0.1, 0, 0), Quaternion(0, 0, 0, 1))))
    here[:3, 3] += 0.1 * here[:3, 0]
    next_of(transforms, lambda m: (b := base(m)) is not None and np.allclose(b, here, atol=1e-9))
    drive.write(Twist(Vector3(0.4, 0.0, 0.0), Vector3(0.0, 0.0, 0.2)))
    # it drives for half a second, since no other command follows: 0.2 m along an arc to the left
    arc = 0.1
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", arc).as_matrix()
    turned[:2, 3] = 2 * np.sin(arc), 2 * (1 - np.cos(arc))
    after = here @ turned
    moved = next_of(transforms, lambda m: (b := base(m)) is not None and np.allclose(b, after, atol=1e-6))
    time.sleep(0.2)
    np.testing.assert_allclose(base(next_of(transforms, lambda m: base(m) is not None)), after, atol=1e-6)
    del images, transforms, clocks, drive, place, node, domain


RCLPY = os.environ.get("FIDSPLAT_RCLPY", "")
"""a Python with rclpy and fidsplat[live]: see examples/ros2_node.py"""


@pytest.mark.skipif(not RCLPY, reason="FIDSPLAT_RCLPY must name a Python with rclpy")
@pytest.mark.parametrize("publisher", [sys.executable, RCLPY], ids=["cyclonedds", "rclpy"])
def test_a_node_of_ros_itself_receives_and_drives(tmp_path, publisher):
    """The example, in ROS's own middleware, with topics of Cyclone DDS and of rclpy."""
    root = Path(__file__).resolve().parents[2]
    (tmp_path / "scene.toml").write_text(SCENE)
    domain = str(201 + (publisher == RCLPY))
    environment = os.environ | {"ROS_DOMAIN_ID": domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    options = ("--ros2", "--lidar", "vlp-16", "--rate", "10")
    command = [publisher, "-m", "fidsplat", "serve", str(tmp_path / "scene.toml"), *options]
    with subprocess.Popen(command, env=environment | {"PYTHONPATH": str(root)}) as server:
        try:
            node = [RCLPY, str(root / "examples" / "ros2_node.py")]
            output = subprocess.run(node, env=environment, capture_output=True, text=True, check=True).stdout
        finally:
            server.terminate()
    assert "/camera/image_raw: 5 messages, 64 x 48, frame camera_optical_frame" in output
    assert "/lidar/points: 5 messages" in output
    assert "the image changes as the robot drives" in output


def test_late_steps_are_dropped_and_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("fidsplat.commands.serve.time.monotonic", lambda: now[0])

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr("fidsplat.commands.serve.interrupts.sleep", sleep)
    clock = _Clock(10.0, 1.0)
    steps = []
    for step, elapsed in clock:
        steps.append(step)
        assert now[0] - 100 >= elapsed - 1e-9
        now[0] += 0.35 if step == 2 else 0.02
    assert steps == [0, 1, 2, 5, 6, 7, 8, 9]
    assert (clock.sent, clock.dropped) == (8, 2)


def test_a_port_in_use_and_wrong_options_are_one_line(tmp_path, capsys, monkeypatch):
    from fidsplat.logs.live import LiveLog

    with LiveLog(port=0) as log, pytest.raises(fs.InputError, match="cannot listen on"):
        LiveLog(port=log.port)
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    assert main(["serve", str(file), "--lidar", "vlp"]) == 2
    assert "unknown lidar 'vlp'" in capsys.readouterr().err
    for options, message in (
        (["--rate", "0"], "--rate must be a number of frames per second, 0.001 to 1000, got 0.0"),
        (
            ["--compress", "--outputs", "depth"],
            "--compress must have rgb among the outputs, got depth; add",
        ),
    ):
        assert main(["serve", str(file), *options]) == 2
        assert message in capsys.readouterr().err
    monkeypatch.setenv("ROS_DOMAIN_ID", "233")
    assert main(["serve", str(file), "--ros2"]) == 2
    assert "ROS_DOMAIN_ID must be a number from 0 to 232, got '233'" in capsys.readouterr().err


def test_an_installation_without_extras_names_live():
    missing = ["rosbags", "mcap", "lz4", "zstandard", "foxglove", "cyclonedds"]
    code = f"import sys; sys.modules |= dict.fromkeys({missing}); from fidsplat.cli import main; exit(main())"
    done = subprocess.run([sys.executable, "-c", code, "serve", "no.toml"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.strip().endswith("fidsplat serve; pip install 'fidsplat[live]'")


@pytest.mark.parametrize(("package", "options"), [("foxglove", []), ("cyclonedds", ["--ros2"])])
def test_a_missing_package_names_its_extra(tmp_path, capsys, monkeypatch, package, options):
    monkeypatch.setattr("fidsplat.commands.options.find_spec", lambda name: None if name == package else name)
    assert main(["serve", str(tmp_path / "scene.toml"), *options]) == 2
    assert (
        f"{package} must be installed for fidsplat serve; pip install 'fidsplat[live]'"
        in capsys.readouterr().err
    )
