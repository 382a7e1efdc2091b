"""Live messages, read by a client that knows Foxglove's protocol and ROS 2's CDR, and nothing of ours."""

import json
import os
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands.serve import _Clock

pytest.importorskip("foxglove", reason="pip install 'fidsplat[live]'")
pytest.importorskip("rosbags", reason="pip install 'fidsplat[logs]'")
websockets = pytest.importorskip("websockets.sync.client", reason="the client of this test")

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
    found = []
    with websockets.connect(
        f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=2**24
    ) as server:
        channels: dict[int, dict] = {}
        while {topic for topic, *_ in found} != wanted and len(found) < 200:
            message = server.recv(timeout=60)
            if isinstance(message, str):
                said = json.loads(message)
                for channel in said.get("channels", ()):
                    if channel["topic"] in wanted:
                        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
                        channels[channel["id"]] = channel
                news = {channel["id"] for channel in said.get("channels", ())}
                if said["op"] == "status":
                    # the server may refuse a channel that it has just announced; then it is requested again
                    time.sleep(0.2)
                    heard = {topic for topic, *_ in found}
                    news = {number for number, one in channels.items() if one["topic"] not in heard}
                for number in news & set(channels):
                    one = {"id": number, "channelId": number}
                    server.send(json.dumps({"op": "subscribe", "subscriptions": [one]}))
            elif message[0] == 1:
                number, stamp = struct.unpack_from("<IQ", message, 1)
                channel = channels[number]
                found.append((channel["topic"], channel["schemaName"], stamp, message[13:]))
    return found


def test_a_client_receives_images_poses_and_points(tmp_path):
    from rosbags.typesys import Stores, get_typestore

    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    options = ("--port", "0", "--lidar", "vlp-16", "--rate", "5", "--duration", "60", "--json")
    command = [sys.executable, "-m", "fidsplat", "serve", str(file), *options]
    quiet = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    with subprocess.Popen(command, **quiet, env=os.environ | {"COLUMNS": "200"}) as served:
        try:
            line = ""
            while "ws://" not in line:
                line = served.stderr.readline()
                assert line, "the server ended"
            port = int(line.rsplit(":", 1)[1])
            topics = {"/camera/image_raw", "/camera/camera_info", "/tf", "/lidar/points"}
            messages = subscribed(port, topics)
        finally:
            served.terminate()
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


def test_late_steps_are_dropped_and_counted(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("fidsplat.commands.serve.time.monotonic", lambda: now[0])

    def sleep(seconds: float) -> None:
        now[0] += seconds

    monkeypatch.setattr("fidsplat.commands.serve.time.sleep", sleep)
    clock = _Clock(10.0, 1.0)
    steps = []
    for step, elapsed in clock:
        steps.append(step)
        assert now[0] - 100 >= elapsed - 1e-9
        now[0] += 0.35 if step == 2 else 0.02
    assert steps == [0, 1, 2, 5, 6, 7, 8, 9]
    assert (clock.sent, clock.dropped) == (8, 2)


def test_a_port_in_use_and_wrong_options_are_one_line(tmp_path, capsys):
    from fidsplat.logs.live import LiveLog

    with LiveLog(port=0) as log, pytest.raises(fs.InputError, match="cannot listen on"):
        LiveLog(port=log.port)
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    assert main(["serve", str(file), "--lidar", "vlp"]) == 2
    assert "unknown lidar 'vlp'" in capsys.readouterr().err
