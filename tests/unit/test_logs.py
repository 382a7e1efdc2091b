"""Logs: other packages of robotics read what is written."""

import contextlib
import json

import numpy as np
import pytest
from full_disk import small_files

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.images.files import to_uint8
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision.detect import Detection, detect

rosbags = pytest.importorskip("rosbags.highlevel", reason="pip install 'fidsplat[logs]'")
mcap_reader = pytest.importorskip("mcap.reader", reason="pip install 'fidsplat[logs]'")

RNG = np.random.default_rng(4)
RGB = RNG.random((24, 32, 3)).astype(np.float32)
DEPTH = RNG.random((24, 32)).astype(np.float32)
LABEL = RNG.integers(-1, 5, (24, 32)).astype(np.int32)
POSE = rigid_matrix((1, 2, 3), (0.9, 0.1, -0.2, 0.3))
TAG = Detection("apriltag", "36h11", 5, None, np.array([[1.0, 2], [3, 2], [3, 4], [1, 4]]))
LENS = fs.Camera.pinhole(32, 24, 30, 31, 16, 12, lens=fs.BrownConrady(k1=-0.1, k2=0.02, p1=0.001, k3=0.003))


def written(path):
    from fidsplat.logs import RobotLog

    with RobotLog(path) as log:
        for time in (0.5, 1.25):
            log.image(time, "front", RGB)
            log.image(time, "front", DEPTH, "depth")
            log.image(time, "front", LABEL, "label")
            log.image(time, "front", RGB, compress="png")
            log.camera_info(time, "front", LENS)
            log.transform(time, "front", POSE)
            log.odometry(time, POSE, velocity=(1, 0, 0), angular_velocity=(0, 0, 0.5))
            log.imu(time, (0, 0, 0.5), (0, 0, 9.81) if time < 1 else None)
            log.detections(time, "front", [TAG])
    return path


def by_rosbags(path):
    with rosbags.AnyReader([path]) as reader:
        return [
            (connection.topic, time, reader.deserialize(data, connection.msgtype))
            for connection, time, data in reader.messages()
        ]


def by_mcap(path):
    ros2 = pytest.importorskip("mcap_ros2.decoder", reason="pip install mcap-ros2-support")
    with path.open("rb") as stream:
        reader = mcap_reader.make_reader(stream, decoder_factories=[ros2.DecoderFactory()])
        return [
            (channel.topic, message.log_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]


ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
"""of OpenCV's coefficients"""


@pytest.mark.parametrize(
    ("kind", "order", "model"),
    [
        (fs.BrownConrady, ORDER[:5], "plumb_bob"),
        (fs.BrownConrady, ORDER[:8], "rational_polynomial"),
        (fs.BrownConrady, ORDER, "rational_polynomial"),
        (fs.Fisheye, ("k1", "k2", "k3", "k4"), "equidistant"),
    ],
)
def test_lenses_have_the_coefficients_of_opencv_in_their_order(tmp_path, kind, order, model):
    from fidsplat.logs import RobotLog

    values = {name: 1e-4 * (k + 1) for k, name in enumerate(order)}
    with RobotLog(tmp_path / "run.mcap") as log:
        log.camera_info(1.0, "front", fs.Camera.pinhole(32, 24, 30, 31, 16, 12, lens=kind(**values)))
    ((_, _, info),) = by_mcap(tmp_path / "run.mcap")
    assert (info.distortion_model, list(info.d)) == (model, list(values.values()))


@pytest.mark.parametrize(("name", "read"), [("run.mcap", by_mcap), ("bag", by_rosbags)])
def test_their_own_readers_read_what_we_write(tmp_path, name, read):
    results = {}
    for topic, time, message in read(written(tmp_path / name)):
        results.setdefault(topic, []).append((time, message))
    assert set(results) == {
        *(f"/front/{part}" for part in ("image_raw", "depth/image_raw", "label/image_raw", "camera_info")),
        *("/front/image_raw/compressed", "/front/detections", "/tf", "/odom", "/imu/data_raw"),
    }
    assert [[time for time, _ in each] for each in results.values()] == [[500_000_000, 1_250_000_000]] * 9
    first = {topic: each[0][1] for topic, each in results.items()}
    image, depth, label = (first[f"/front/{part}image_raw"] for part in ("", "depth/", "label/"))
    assert (image.encoding, image.height, image.width, image.step) == ("rgb8", 24, 32, 96)
    assert (image.header.frame_id, image.header.stamp.nanosec) == ("front", 500_000_000)
    pixels = np.frombuffer(bytes(image.data), np.uint8).reshape(24, 32, 3)
    np.testing.assert_allclose(pixels / 255, RGB, atol=0.51 / 255)
    np.testing.assert_array_equal(np.frombuffer(bytes(depth.data), np.float32).reshape(24, 32), DEPTH)
    np.testing.assert_array_equal(np.frombuffer(bytes(label.data), np.int32).reshape(24, 32), LABEL)
    info = first["/front/camera_info"]
    assert (info.distortion_model, list(info.d)) == ("plumb_bob", [-0.1, 0.02, 0.001, 0.0, 0.003])
    assert list(info.k) == [30, 0, 15.5, 0, 31, 11.5, 0, 0, 1]
    assert list(info.p) == [30, 0, 15.5, 0, 0, 31, 11.5, 0, 0, 0, 1, 0]
    (moved,) = first["/tf"].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("map", "front")
    rotation = moved.transform.rotation
    np.testing.assert_allclose(
        rigid_matrix((1, 2, 3), (rotation.w, rotation.x, rotation.y, rotation.z)), POSE, atol=1e-12
    )
    odometry = first["/odom"]
    assert (odometry.pose.pose.position.z, odometry.twist.twist.angular.z) == (3, 0.5)
    assert (
        first["/imu/data_raw"].linear_acceleration.z,
        first["/imu/data_raw"].orientation_covariance[0],
    ) == (9.81, -1)
    not_measured = [each.linear_acceleration_covariance[0] for _, each in results["/imu/data_raw"]]
    assert not_measured == [0, -1]
    (tag,) = first["/front/detections"].detections
    assert (tag.family, tag.id, tag.corners[2].x, tag.centre.y) == ("36h11", 5, 2.5, 2.5)


@pytest.fixture(scope="module")
def tag_picture():
    tag = fs.marker("apriltag:36h11:5", size=1.0)
    camera = fs.Camera.pinhole(120, 100, 120, 120, 60, 50, rigid_matrix((0, 0, 2)))
    frame = fs.Renderer("reference").render(tag.cloud, camera, background=(0.5, 0.5, 0.5))
    return frame["rgb"]


@pytest.mark.parametrize(("name", "compress"), [("run.mcap", None), ("bag", "jpeg")])
def test_detect_reads_logs(tmp_path, capsys, tag_picture, name, compress):
    from fidsplat.logs import RobotLog

    with RobotLog(tmp_path / name) as log:
        for time in (0.0, 0.1):
            log.image(time, "front", tag_picture, compress=compress)
            log.image(time, "front", DEPTH, "depth")
    assert main(["detect", str(tmp_path / name), "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["pictures"]
    assert [p["image"] for p in results] == [
        f"/front/image_raw{'/compressed' if compress else ''} {time} s" for time in ("0.000", "0.100")
    ]
    assert all(p["detections"][0]["name"] == "apriltag:36h11:5" for p in results)
    (there,) = detect(to_uint8(tag_picture))
    np.testing.assert_allclose(results[0]["detections"][0]["corners"], there.corners, atol=0.1)
    assert main(["detect", str(tmp_path / name), "--topic", "/rear"]) == 2
    assert "must have colour images on /rear" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_a_log_that_is_there_stays_as_it_is(tmp_path, name):
    from fidsplat.logs import RobotLog

    path = written(tmp_path / name)
    with pytest.raises(fs.InputError, match="already exists"):
        RobotLog(path)
    with pytest.raises(fs.InputError, match="must be seconds"), RobotLog(path, overwrite=True) as log:
        log.image(-1.0, "front", RGB)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    read = by_mcap if name.endswith("mcap") else by_rosbags
    assert len(read(path)) == 18
    with RobotLog(path, overwrite=True) as log:
        log.image(0.0, "front", RGB)
    assert len(read(path)) == 1


def test_what_a_log_cannot_take(tmp_path):
    from fidsplat.logs import RobotLog, log_images

    with RobotLog(tmp_path / "run.mcap") as log:
        log.image(1.0, "front", RGB)
        log.image(0.5, "rear", RGB)  # another topic's clock
        with pytest.raises(fs.InputError, match=r"time of /front/image_raw must be at least 1 s, got 0\.9 s"):
            log.image(0.9, "front", RGB)
        with pytest.raises(fs.InputError, match="must be seconds from 0"):
            log.image(-1.0, "side", RGB)
        with pytest.raises(fs.InputError, match="for rgb only"):
            log.image(1.0, "front", DEPTH, "depth", compress="png")
        with pytest.raises(fs.InputError, match="the pose of front must be rigid"):
            log.transform(1.0, "front", np.diag([2, 2, 2, 1]))
        with pytest.raises(fs.InputError, match="unknown lens of ROS's CameraInfo 'orthographic'"):
            log.camera_info(1.0, "front", fs.Camera.orthographic(32, 24, 1.0))
    (tmp_path / "folder").mkdir()
    with pytest.raises(fs.InputError, match=r"must have metadata\.yaml"):
        RobotLog(tmp_path / "folder", overwrite=True)
    with pytest.raises(fs.InputError, match="cannot write"):
        RobotLog(tmp_path / "none/run.mcap")
    (tmp_path / "bad.mcap").write_bytes(b"not a log")
    with pytest.raises(fs.InputError, match=r"cannot read .* as a log"):
        list(log_images(tmp_path / "bad.mcap"))


def fill(path):
    from fidsplat.logs import RobotLog

    with RobotLog(path) as log:
        for k in range(60):
            log.image(float(k), "front", RNG.random((64, 64, 3)))


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_a_disk_that_is_full_leaves_nothing(tmp_path, name):
    with small_files(200_000), pytest.raises(fs.InputError, match="cannot write"):
        fill(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("up", [(0, -1, 0), (0, 0, 1), (0, 0, -2), (0.6, 0, 0.8)])
def test_frames_follow_rep_103_and_105(tmp_path, up):
    from scipy.spatial.transform import RigidTransform, Rotation

    from fidsplat.logs import RobotLog, log_poses

    with RobotLog(tmp_path / "bag", up=up) as log:
        log.image(1.0, "front", DEPTH, "depth")
        log.camera_info(1.0, "front", LENS, "depth")
        log.camera_pose(1.0, "front", POSE)
    messages = {topic: message for topic, _, message in by_rosbags(tmp_path / "bag")}
    for topic in ("image_raw", "camera_info"):
        assert messages[f"/front/depth/{topic}"].header.frame_id == "front_optical_frame"
    tree = {}
    for one in messages["/tf"].transforms:
        at, rotation = one.transform.translation, one.transform.rotation
        pose = RigidTransform.from_components(
            [at.x, at.y, at.z], Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w])
        )
        tree[one.header.frame_id, one.child_frame_id] = pose
    map_from_scene, map_from_link = tree["map", "scene"], tree["map", "front_link"]
    optical = tree["front_link", "front_optical_frame"]
    np.testing.assert_allclose(map_from_scene.apply(up) / np.linalg.norm(up), (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(optical.apply(np.eye(3)), [(0, -1, 0), (0, 0, -1), (1, 0, 0)], atol=1e-12)
    there = map_from_scene.inv() * map_from_link * optical
    np.testing.assert_allclose(there.as_matrix(), POSE, atol=1e-12)
    np.testing.assert_allclose(log_poses(tmp_path / "bag")["front_optical_frame", 10**9], POSE, atol=1e-12)


def test_up_is_checked(tmp_path):
    from fidsplat.logs import RobotLog

    for up in ((0, 0, 0), (1, 2), "up"):
        with pytest.raises(fs.InputError, match="up must be"):
            RobotLog(tmp_path / "a.mcap", up=up)


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_damaged_logs(tmp_path, name):
    from fidsplat.logs import log_images

    path = written(tmp_path / name)
    file = path if path.is_file() else next(path.glob("*.db3"))
    contents = file.read_bytes()
    random = np.random.default_rng(0)
    for k in range(40):
        data = bytearray(contents[: random.integers(1, len(contents))] if k % 2 else contents)
        for place in random.integers(0, len(data), 30):
            data[place] = random.integers(256)
        file.write_bytes(data)
        with contextlib.suppress(fs.InputError):
            for image in (one.image for one in log_images(path)):
                assert image.shape[2] == 3


@pytest.mark.parametrize("name", ["run.mcap", "bag"])
def test_times_up_to_the_last_that_a_stamp_holds(tmp_path, name):
    from fidsplat.logs import RobotLog, log_images

    last = 2**31 - 1
    with RobotLog(tmp_path / name) as log:
        for time in (0.0, float(last)):
            log.image(time, "front", RGB)
        for late in (last + 0.5, np.nextafter(last, np.inf), 2.0**31):
            with pytest.raises(fs.InputError, match="must be seconds from 0"):
                log.image(late, "front", RGB)
    assert [one.stamp for one in log_images(tmp_path / name)] == [0, last * 10**9]
