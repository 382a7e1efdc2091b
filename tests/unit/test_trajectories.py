"""Trajectories: smooth curves, samples, vectors, and the files that hold them."""

import json
import math
import struct

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.splats.rotations import quaternion_to_matrix, rigid_matrix

CAMERA = fs.Camera.pinhole(640, 480, 500.0, 510.0, 320.0, 240.0)


def some(count=6, seed=3, smooth=False) -> fs.Trajectory:
    generator = np.random.default_rng(seed)
    quats = generator.normal(size=(count, 4))
    poses = [rigid_matrix(generator.uniform(-4, 4, 3), q) for q in quats]
    return fs.Trajectory(np.cumsum(generator.uniform(0.1, 2.0, count)), np.array(poses), smooth)


def test_vectors_are_the_poses():
    path = some()
    again = fs.Trajectory(path.times, path.vectors)
    np.testing.assert_allclose(again.poses, path.poses, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(path.vectors[:, 3:], axis=1), 1)
    one = fs.Trajectory([0.0], [[1, 2, 3, math.cos(0.5), 0, 0, math.sin(0.5)]])(7.0)
    np.testing.assert_allclose(one[:2, :2], [[math.cos(1), -math.sin(1)], [math.sin(1), math.cos(1)]])
    assert one[:3, 3].tolist() == [1, 2, 3]
    assert len(path) == 6
    assert repr(path).startswith("Trajectory(6 poses, ")


@pytest.mark.parametrize("smooth", [False, True])
def test_the_inverse_is_the_inverse_at_every_time(smooth):
    path = some(smooth=smooth)
    back = path.inverse()
    for time in np.linspace(path.times[0], path.times[-1], 17):
        np.testing.assert_allclose(path(time) @ back(time), np.eye(4), atol=1e-9)


def test_a_smooth_curve_has_no_kink():
    path = some(smooth=True)  # of uneven times and turns
    assert np.abs(path._velocities[:, :3]).max() > 1
    for k in range(1, len(path) - 1):
        time, step = path.times[k], 1e-6
        np.testing.assert_allclose(path(time), path.poses[k], atol=1e-12)
        before = (path(time) - path(time - step)) / step
        after = (path(time + step) - path(time)) / step
        np.testing.assert_allclose(before, after, atol=1e-3)
    kinked = fs.Trajectory(path.times, path.poses)
    time = path.times[2]
    jump = (kinked(time + 1e-6) - 2 * kinked(time) + kinked(time - 1e-6)) / 1e-6
    assert np.abs(jump).max() > 0.1


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_a_smooth_curve_backwards_is_the_same_curve(count):
    """So that its two ends follow the same rule: between two keyframes a screw motion."""
    path = some(count, smooth=True)
    back = fs.Trajectory(-path.times[::-1], path.poses[::-1], smooth=True)
    for time in np.linspace(path.times[0], path.times[-1], 40):
        np.testing.assert_allclose(path(time), back(-time), atol=1e-12)
        if count == 2:
            np.testing.assert_allclose(path(time), fs.Trajectory(path.times, path.poses)(time), atol=1e-12)


def test_a_smooth_curve_follows_a_parabola():
    """Between inner keyframes, however uneven they are, and without a turn."""
    times = np.array([0.0, 0.2, 1.0, 1.1, 3.0])
    places = np.stack([2 * times, times**2, -0.5 * times**2], axis=1)
    vectors = np.column_stack([places, np.tile([1.0, 0, 0, 0], (5, 1))])
    path = fs.Trajectory(times, vectors, smooth=True)
    for time in (0.3, 0.7, 1.05):
        np.testing.assert_allclose(path(time)[:3, 3], [2 * time, time**2, -0.5 * time**2], atol=1e-12)


def test_a_smooth_circle_stays_round():
    """Keyframes of an orbit: a screw motion is an arc, so the curve is the orbit itself."""
    angles = np.array([0.0, 0.5, 1.5, 2.0])
    poses = []
    for angle in angles:
        rotation = quaternion_to_matrix(np.array([math.cos(angle / 2), 0, math.sin(angle / 2), 0]))
        poses.append(np.eye(4))
        poses[-1][:3, :3], poses[-1][:3, 3] = rotation, rotation @ [0, 0, -2]
    path = fs.Trajectory(angles, poses, smooth=True)
    for time in np.linspace(0, 2, 9):
        assert np.linalg.norm(path(time)[:3, 3]) == pytest.approx(2, abs=1e-12)


def test_samples_are_taken_at_a_rate():
    path = fs.Trajectory([1.0, 2.0], [[0, 0, 0, 1, 0, 0, 0], [1, 0, 0, 1, 0, 0, 0]])
    samples = path.sampled(10)
    assert len(samples) == 11  # both ends
    np.testing.assert_allclose(samples.times, np.linspace(1, 2, 11))
    np.testing.assert_allclose(samples.poses[:, 0, 3], np.linspace(0, 1, 11), atol=1e-12)
    assert len(path.sampled(0.9)) == 1
    assert len(fs.Trajectory([5.0], [np.eye(4)]).sampled(30)) == 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.Trajectory([0, 1, 1], np.zeros((3, 7))), r"got 1 and then 1 \(number 2"),
        (
            lambda: fs.Trajectory([0.0], [[0, 0, 0, 1, 1, 0, 0]]),
            "quaternion w, x, y, z .* length 1, got 1.41421",
        ),
        (lambda: fs.Trajectory([0.0], [[0, 0, math.nan, 1, 0, 0, 0]]), "pose 0 .* 7 finite numbers"),
        (
            lambda: fs.Trajectory([0.0], np.eye(4)[None], smooth="yes"),
            "smooth must be True or False, got 'yes'",
        ),
        (lambda: some().sampled(0), "the rate must be .* above 0, got 0"),
        (lambda: some().sampled(math.inf), "the rate must be .* got inf"),
        (lambda: some().sampled(1e9), "at most 10,000,000 poses, got 1e\\+09 per second over"),
    ],
)
def test_values_that_are_not_a_trajectory(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


@pytest.mark.parametrize("name", ["run.tum", "run.txt", "run.kitti", "transforms.json", "model"])
def test_files_come_back(tmp_path, name):
    path = some()
    fs.save_trajectory(path, tmp_path / name, CAMERA)
    again = fs.load_trajectory(tmp_path / name, rate=4.0)
    np.testing.assert_allclose(again.poses, path.poses, atol=1e-12)
    timed = name not in ("run.kitti", "model")
    np.testing.assert_allclose(again.times, path.times if timed else np.arange(6) / 4.0)


def test_what_a_file_of_each_format_says(tmp_path):
    """As their specifications have it, for a camera at (1, 2, 3) turned a quarter about its own y."""
    half = math.sqrt(0.5)
    pose = rigid_matrix((1, 2, 3), (half, 0, half, 0))  # x to -z, z to x
    path = fs.Trajectory([1.5], [pose])
    fs.save_trajectory(path, tmp_path / "a.tum")
    line = (tmp_path / "a.tum").read_text().splitlines()[1].split()
    np.testing.assert_allclose([float(w) for w in line], [1.5, 1, 2, 3, 0, half, 0, half])
    fs.save_trajectory(path, tmp_path / "a.kitti")
    row = [float(w) for w in (tmp_path / "a.kitti").read_text().split()]
    np.testing.assert_allclose(row, [0, 0, 1, 1, 0, 1, 0, 2, -1, 0, 0, 3], atol=1e-15)
    fs.save_trajectory(path, tmp_path / "a.json", CAMERA, ["images/x.png"])
    printed = json.loads((tmp_path / "a.json").read_text())
    assert (printed["w"], printed["h"], printed["fl_x"], printed["fl_y"]) == (640, 480, 500.0, 510.0)
    frame = printed["frames"][0]
    assert (frame["file_path"], frame["time"]) == ("images/x.png", 1.5)
    # OpenGL: the camera looks along its own -z, so the third column is backwards, the second up
    expected = [[0, 0, -1, 1], [0, -1, 0, 2], [-1, 0, 0, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(frame["transform_matrix"], expected, atol=1e-15)


def test_colmap_reads_what_is_written(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP's files by itself")
    path = some()
    fs.save_trajectory(path, tmp_path / "model", CAMERA)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    images = sorted(model.images.values(), key=lambda image: image.name)
    actual = [image.cam_from_world().inverse().matrix() for image in images]
    np.testing.assert_allclose(actual, path.poses[:, :3], atol=1e-12)


def test_colmaps_images_come_in_the_order_of_their_names(tmp_path):
    """With points that are visible, in text and in binary; the second line of an image may be empty."""
    rows = [("b.png", 2.0, 2), ("a.png", 1.0, 0)]
    text = "# a comment\n" + "".join(
        f"{k} 1 0 0 0 0 0 {-z} 1 {name}\n{'1.0 2.0 -1 ' * seen}\n" for k, (name, z, seen) in enumerate(rows)
    )
    binary = struct.pack("<Q", 2) + b"".join(
        struct.pack("<i7di", k, 1, 0, 0, 0, 0, 0, -z, 1)
        + name.encode()
        + b"\0"
        + struct.pack("<Q", seen)
        + struct.pack("<ddq", 1.0, 2.0, -1) * seen
        for k, (name, z, seen) in enumerate(rows)
    )
    (tmp_path / "images.txt").write_text(text)
    (tmp_path / "images.bin").write_bytes(binary)
    for name in ("images.txt", "images.bin", "."):
        path = fs.load_trajectory(tmp_path / name)
        assert path.poses[:, 2, 3].tolist() == [1.0, 2.0]
        np.testing.assert_allclose(path.times, [0, 0.1])
    for cut in (4, 20, 60, len(binary) - 1):
        (tmp_path / "images.bin").write_bytes(binary[:cut])
        with pytest.raises(fs.InputError, match=r"cannot read .* as COLMAP"):
            fs.load_trajectory(tmp_path / "images.bin")


def test_rounded_files_are_read(tmp_path):
    """Six digits, as KITTI prints them, commas and comments."""
    pose = some().poses[0]
    (tmp_path / "a.kitti").write_text(" ".join(f"{v:e}" for v in pose[:3].ravel()) + "\n")
    np.testing.assert_allclose(fs.load_trajectory(tmp_path / "a.kitti").poses[0], pose, atol=1e-5)
    (tmp_path / "a.csv").write_text("# t x y z qx qy qz qw\n0.5, 1, 2, 3, 0, 0, 0, 0.9999\n")
    read = fs.load_trajectory(tmp_path / "a.csv", smooth=True)
    assert (read.times.tolist(), read.poses[0, :3, 3].tolist()) == ([0.5], [1, 2, 3])
    assert read.smooth


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.tum", "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: times must increase, got 1 after 1"),
        ("a.tum", "1 0 0 nan 0 0 0 1\n", "line 1: numbers must be finite, got nan"),
        ("a.tum", "1 0 0 0 0 0 0 2\n", "line 1: the length of the quaternion must be 1, got 2"),
        ("a.tum", "1 0 0 0 0 0 0\n", r"line 1: a line must have 8 \(TUM\) or 12 \(KITTI\) numbers, got 7"),
        ("a.tum", "1 0 0 0 0 0 0 1\n" + "0 " * 12, "line 2: a line must have 8 numbers, got 12"),
        ("a.tum", "one 0 0 0 0 0 0 1\n", "line 1: a line must have numbers, got 'one 0 0 0 0 0 0 1'"),
        ("a.tum", "# nothing\n\n", "must have at least one pose, got none"),
        (
            "a.kitti",
            "2 0 0 0 0 2 0 0 0 0 2 0\n",
            "line 1: the matrix must be a rotation, whose scales are 1, got 2, 2, 2",
        ),
        ("a.kitti", "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: the matrix must be a rotation"),
        ("t.json", "{", 'must have "frames"'),
        ("t.json", '{"frames": [{"transform_matrix": [[1, 2]]}]}', "must be 4 x 4 finite numbers"),
        ("t.json", '{"frames": []}', "must have at least one pose, got none"),
        pytest.param(
            "t.json", f'{{"frames": [{{"transform_matrix": [[1{"0" * 400}]]}}]}}', "OverflowError", id="big"
        ),
        ("images.txt", "1 1 0 0\n\n", "cannot read .* as COLMAP"),
    ],
)
def test_damaged_files(tmp_path, name, content, words):
    (tmp_path / name).write_text(content)
    with pytest.raises(fs.InputError, match=words):
        fs.load_trajectory(tmp_path / name)


def test_files_that_hold_no_trajectory(tmp_path):
    eye = [np.eye(4).tolist()] * 2
    frames = [{"transform_matrix": m, "time": 1.0} for m in eye]
    (tmp_path / "t.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(fs.InputError, match=r"t.json: the times .* got 1 and then 1"):
        fs.load_trajectory(tmp_path / "t.json")
    (tmp_path / "large.tum").write_bytes(b"")
    with (tmp_path / "large.tum").open("r+b") as stream:
        stream.truncate(5 * 2**30)  # no disk is used
    (tmp_path / "bytes.tum").write_bytes(b"\xff\xfe")
    for name, words in (
        ("large.tum", "at most 268,435,456 bytes, got 5,368,709,120"),
        ("bytes.tum", "a trajectory must be text in UTF-8, got"),
        ("none.tum", "cannot read"),
        (".", r"t.json|a trajectory folder must have images.bin"),
    ):
        with pytest.raises(fs.InputError, match=words):
            fs.load_trajectory(tmp_path / name)


def test_lenses_of_transforms_json_are_those_of_opencv(tmp_path):
    points, still = np.random.default_rng(3).uniform((-1, -1, 2), (1, 1, 3), (20, 3)), np.zeros(3)
    brown = fs.Camera.pinhole(64, 48, 50.0, 52.0, 31.0, 25.0, lens=fs.BrownConrady(k1=-0.1, p2=0.01, k4=0.02))
    for camera in (fs.Camera.fisheye(64, 48, 2.0, coefficients=(0.1, -0.02, 0.003, 0.001)), brown):
        fs.save_trajectory(some(), tmp_path / "a.json", camera)
        printed = json.loads((tmp_path / "a.json").read_text())
        fisheye = printed["camera_model"] == "OPENCV_FISHEYE"
        names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        matrix = np.array(
            [[printed["fl_x"], 0, printed["cx"]], [0, printed["fl_y"], printed["cy"]], [0, 0, 1]]
        )
        project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
        values = np.array([printed.get(name, 0.0) for name in names])
        theirs, _ = project(points[:, None], still, still, matrix, values)
        np.testing.assert_allclose(theirs[:, 0], camera.project(points), atol=1e-9)


def test_what_cannot_be_written(tmp_path):
    lens = fs.Camera.fisheye(64, 48, 2.0)
    prism = fs.Camera.pinhole(64, 48, 50.0, 50.0, 32.0, 24.0, lens=fs.BrownConrady(s1=0.01))
    for name, camera, images, words in (
        ("a.csv", CAMERA, None, "the suffix of a trajectory must be one of .tum and .txt .TUM., .kitti,"),
        ("a.json", None, None, "camera must be a Camera for .*, got None; give camera="),
        ("model", None, None, "camera must be a Camera for .*, got None; give camera="),
        ("model", lens, None, r"must be a pinhole, got the lens fisheye"),
        ("a.json", prism, None, r"without s1 to s4, got BrownConrady"),
        ("a.json", CAMERA, ["x"], "a name for each of 6 poses"),
    ):
        with pytest.raises(fs.InputError, match=words):
            fs.save_trajectory(some(), tmp_path / name, camera, images)
    assert list(tmp_path.iterdir()) == []
