"""Poses as functions of time, shutters, and how scene files say them."""

import itertools
import math

import numpy as np
import pytest
from agreement import random_splats

import fidsplat as fs
from fidsplat.backends.prepare import view_of
from fidsplat.cameras.screw import interpolate
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import quaternion_to_matrix


def random_pose(generator, angle=None):
    pose = np.eye(4)
    axis = generator.normal(size=3)
    axis /= np.linalg.norm(axis)
    half = (generator.uniform(0, math.pi) if angle is None else angle) / 2
    pose[:3, :3] = quaternion_to_matrix(np.array([math.cos(half), *(math.sin(half) * axis)]))
    pose[:3, 3] = generator.uniform(-5, 5, 3)
    return pose


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.5, 2.0, 3.1])
def test_between_two_poses_is_one_screw_motion(angle):
    """Equal steps are the same motion again, whichever end one starts from."""
    generator = np.random.default_rng(1)
    start = random_pose(generator)
    end = start @ random_pose(generator, angle)
    steps = [interpolate(start, end, k / 4) for k in range(5)]
    np.testing.assert_allclose(steps[0], start, atol=1e-12)
    np.testing.assert_allclose(steps[4], end, atol=1e-9)
    first = np.linalg.inv(steps[0]) @ steps[1]
    for a, b in itertools.pairwise(steps):
        np.testing.assert_allclose(np.linalg.inv(a) @ b, first, atol=1e-9)
    np.testing.assert_allclose(interpolate(end, start, 0.25), steps[3], atol=1e-8)
    inverse = interpolate(np.linalg.inv(start), np.linalg.inv(end), 0.25)
    np.testing.assert_allclose(np.linalg.inv(inverse), steps[1], atol=1e-8)


def test_a_trajectory_rests_before_and_after():
    generator = np.random.default_rng(2)
    poses = [random_pose(generator) for _ in range(3)]
    path = fs.Trajectory([0.0, 1.0, 3.0], poses)
    assert (path(-5.0) == poses[0]).all()
    assert (path(9.0) == poses[2]).all()
    np.testing.assert_allclose(path(1.0), poses[1], atol=1e-12)
    np.testing.assert_allclose(path(2.5), interpolate(poses[1], poses[2], 0.75), atol=1e-12)


def test_a_camera_that_moves_is_elsewhere():
    pose = random_pose(np.random.default_rng(4))
    camera = fs.Camera.look_at(8, 6, 1.0, (0, 0, -1), (0, 0, 0))
    moved = fs.Motion(camera=lambda time: pose if time == 2.0 else np.eye(4)).moved(camera, 2.0)
    assert (moved.world_to_camera == pose).all()
    np.testing.assert_allclose(moved.position, np.linalg.inv(pose)[:3, 3], atol=1e-12)
    assert fs.Motion().moved(camera, 2.0) is camera


def test_when_rows_are_exposed():
    shutter = fs.Shutter(time=2.0, exposure_time=0.4, sub_poses=4, readout=1.0, rows_per_band=4)
    bands = shutter.bands(10)
    assert [(top, end) for top, end, _ in bands] == [(0, 4), (4, 8), (8, 10)]
    assert [time for *_, time in bands] == pytest.approx([1.7, 2.1, 2.4])
    assert shutter.times(2.0) == pytest.approx([1.85, 1.95, 2.05, 2.15])
    assert fs.Shutter(time=3.0).bands(10) == [(0, 10, 3.0)]
    assert fs.Shutter().times(1.0) == [1.0]


TAG = fs.marker("aruco:4x4_50:7", size=0.2, mixture="fitted")
MOVING = fs.Motion(lambda time: np.eye(4), {1: lambda time: np.eye(4)})


@pytest.mark.parametrize(
    ("motion", "shutter", "sub_frames"),
    [
        (MOVING, fs.Shutter(time=0.3, sub_poses=4, rows_per_band=2), 0),
        (MOVING, fs.Shutter(exposure_time=0.1, sub_poses=1), 0),
        (MOVING, fs.Shutter(readout=0.1, rows_per_band=48), 0),
        (fs.Motion(), fs.Shutter(exposure_time=0.1, readout=0.1), 0),
        (MOVING, fs.Shutter(exposure_time=0.1, sub_poses=2, readout=0.1, rows_per_band=40), 4),
    ],
)
def test_a_shutter_that_does_nothing_is_none(motion, shutter, sub_frames):
    """One image, without the code of several."""
    camera = fs.Camera.pinhole(64, 48, 50, 50, 32, 24)
    view = view_of(fs.Capture(camera, motion=motion, shutter=shutter), np.zeros(3))
    assert len(view.sub_frames) == sub_frames


def test_a_group_moves_about_the_worlds_origin_wherever_the_clouds_is():
    """A splat's place in the camera frame: its own in the world, moved, then seen; and whence it is
    visible."""
    generator = np.random.default_rng(3)
    pose, moved, origin = random_pose(generator), random_pose(generator), np.array([100.0, -20.0, 7.0])
    camera = fs.Camera.pinhole(8, 6, 5, 5, 4, 3, world_to_camera=pose)
    capture = fs.Capture(camera, motion=fs.Motion(groups={1: lambda time: moved}))
    ((_, view),) = view_of(capture, origin).groups
    local = np.array([0.3, 0.2, -0.1])
    seen = (pose @ moved @ np.append(origin + local, 1))[:3]
    np.testing.assert_allclose(view.rotation @ local + view.translation, seen, atol=1e-12)
    np.testing.assert_allclose(view.rotation @ (local - view.eye), seen, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.Shutter(exposure_time=-1.0), "exposure_time must be 0 or more seconds, got -1.0"),
        (lambda: fs.Shutter(readout=-1e-3), "readout must be 0 or more"),
        (lambda: fs.Shutter(time=math.nan), "time must be a finite number"),
        (lambda: fs.Shutter(sub_poses=0), "sub_poses must be a whole number, 1 to 1024, got 0"),
        (lambda: fs.Shutter(rows_per_band=0.5), "rows_per_band must be a whole number, 1 or more"),
        (lambda: fs.Trajectory([0, 0], [np.eye(4)] * 2), "increasing"),
        (lambda: fs.Trajectory([0], [np.eye(4)] * 2), "one pose for each of 1 times, got 2"),
        (lambda: fs.Trajectory([0], None), "one pose for each of 1 times, got 0"),
        (lambda: fs.Trajectory([0], [2 * np.eye(4)]), "pose 0 of a trajectory"),
        (lambda: fs.Motion(camera=np.eye(4)), "Trajectory or a function"),
        (lambda: fs.Motion(groups={1: np.eye(4)}), "Trajectory or function"),
        (
            lambda: fs.Motion(groups={"tag": lambda t: np.eye(4)}),
            "group must be a whole number, got 'tag'",
        ),
        (lambda: fs.Trajectory(["noon"], [np.eye(4)]), r"increasing numbers of seconds, got \['noon'\]"),
        (lambda: PlacedMarker(None, motion=np.eye(4)), "a marker's motion must be .*function of time"),
        (lambda: fs.Scene(camera_motion=np.eye(4)), "must be a Trajectory or a function"),
        (
            lambda: fs.Scene(markers=[PlacedMarker(TAG, motion=lambda t: None)]).motion.groups_at(0.5),
            "a marker's pose at 0.5 s must be a 4x4 matrix",
        ),
        (lambda: fs.Scene(cloud_motions={0: np.eye(4)}), "cloud_motions must be"),
        (lambda: fs.Scene(cloud_motions={0: lambda t: np.eye(4)}), "numbers of clouds below 0, got 0"),
        (lambda: fs.Motion(groups={1: lambda t: np.zeros((4, 4))}).groups_at(0), "label 1 at 0 s"),
    ],
)
def test_what_cannot_move_so(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


SCENE = """
[camera]
width = 64
height = 48
fov_x_deg = 60.0

[camera.shutter]
exposure_time_ms = 10.0
sub_poses = 4
readout_ms = 20.0

[[camera.motion]]
time = 0.0
position = [0, 0, -1]
look_at = [0, 0, 0]

[[camera.motion]]
time = 0.5
position = [0.5, 0, -1]
look_at = [0, 0, 0]

[[markers]]
spec = "aruco:4x4_50:7"
size = 0.2
motion = [{time = 0.0, position = [0, 0, 0]}, {time = 1.0, position = [1, 0, 0], quaternion = [0, 0, 0, 1]}]
"""


def test_scene_files_say_what_moves(tmp_path):
    (tmp_path / "a.toml").write_text(SCENE)
    first = fs.Scene.load(tmp_path / "a.toml")
    first.save(tmp_path / "b.toml")
    for scene in (first, fs.Scene.load(tmp_path / "b.toml")):
        assert scene.shutter == fs.Shutter(exposure_time=0.01, sub_poses=4, readout=0.02)
        np.testing.assert_allclose(scene.camera.position, [0, 0, -1], atol=1e-12)
        position = np.linalg.inv(scene.motion.camera_at(0.5))[:3, 3]
        np.testing.assert_allclose(position, [0.5, 0, -1], atol=1e-12)
        ((label, moved),) = scene.motion.groups_at(1.0)
        assert label == 1
        np.testing.assert_allclose(moved @ [0.1, 0, 0, 1], [0.9, 0, 0, 1], atol=1e-12)


def test_a_marker_moves_from_where_it_is_rendered(tmp_path):
    """A marker's own pose is that of its splats in the cloud; the motion starts from it."""
    text = SCENE.replace("size = 0.2", "size = 0.2\nposition = [0.0, 3.0, 0.0]")
    (tmp_path / "a.toml").write_text(text)
    scene = fs.Scene.load(tmp_path / "a.toml")
    corner = np.append(scene.markers[0].corners[0], 1)
    ((_, moved),) = scene.motion.groups_at(0.0)
    np.testing.assert_allclose((moved @ corner)[:3], [-0.1, -0.1, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "exposure_time_ms = 10.0",
            "exposure_time_ms = -1.0",
            "camera.shutter: shutter exposure_time must be 0 or more",
        ),
        ("exposure_time_ms", "exposure_ms", "'camera.shutter.exposure_ms' .did you mean 'exposure_time_ms"),
        ("time = 0.5", "time = 0.0", r"camera.motion\[1\].time must be above"),
        ("time = 1.0", "time = -1.0", r"markers\[0\].motion\[1\].time must be above"),
        ("fov_x_deg = 60.0", "fov_x_deg = 60.0\nposition = [0, 0, 0]", "position and motion exclude"),
        ("[[camera.motion]]\ntime = 0.0\n", "[[camera.motion]]\n", r"camera.motion\[0\].time is missing"),
    ],
)
def test_motions_that_scene_files_cannot_have(tmp_path, old, new, words):
    assert old in SCENE
    (tmp_path / "a.toml").write_text(SCENE.replace(old, new, 1))
    with pytest.raises(fs.InputError, match=words):
        fs.Scene.load(tmp_path / "a.toml")


SPLATS = """
[camera]
width = 40
height = 30
fov_x_deg = 60.0
position = [0, 0, -1]
look_at = [0, 0, 1]

[camera.shutter]
time = 0.5

[[splats]]
file = "still.ply"

[[splats]]
file = "moving.ply"
position = [0, 0, 2]
quaternion = [1, 0.2, 0, 0]
scale = 0.5
motion = [
    {time = 0.0, position = [-1, 0, 2], quaternion = [1, 0, 0, 0.5]},
    {time = 1.0, position = [1, 0, 2], quaternion = [1, 0, 0, 0.5]},
]

[[markers]]
spec = "aruco:4x4_50:7"
size = 0.2
position = [0.5, 0.5, 1.0]
"""


@pytest.fixture
def splats(tmp_path):
    """A scene file of a still and a moving cloud, which have labels of their own, and a marker."""
    fs.save_ply(random_splats(20, 1, depth=(1, 3)).with_labels([0, 1, 2, 4] * 5), tmp_path / "still.ply")
    fs.save_ply(random_splats(30, 2, depth=(-1, 1)).with_labels(1), tmp_path / "moving.ply")
    (tmp_path / "a.toml").write_text(SPLATS)
    return fs.Scene.load(tmp_path / "a.toml")


def test_splat_files_move_by_themselves(tmp_path, splats):
    """Each cloud moves from its initial pose; compared with a file that is at the moved pose."""
    splats.save(tmp_path / "b.toml")
    start = SPLATS.index("motion")
    there = SPLATS.replace(SPLATS[start : SPLATS.index("]\n\n[[markers]]") + 2], "", 1)
    there = there.replace(
        "position = [0, 0, 2]\nquaternion = [1, 0.2, 0, 0]",
        "quaternion = [1, 0, 0, 0.5]\nposition = [0, 0, 2]",
    )
    (tmp_path / "there.toml").write_text(there)
    expected = fs.Renderer("reference").render(fs.Scene.load(tmp_path / "there.toml"))["rgb"]
    for scene in (splats, fs.Scene.load(tmp_path / "b.toml")):
        rendered = fs.Renderer("reference").render(scene)["rgb"]
        np.testing.assert_allclose(rendered, expected, atol=1e-4)
        assert scene.cloud().labels[20:].tolist() == [3] * 30 + [1] * (len(scene.cloud()) - 50)
        assert [label for label, _ in scene.motion.groups_at(0.5)] == [3]


def test_a_cloud_that_moves_has_a_label_that_no_other_has(splats):
    clouds = [*splats.clouds, splats.clouds[1]]
    scene = fs.Scene(clouds, cloud_motions={1: lambda t: np.eye(4), 2: lambda t: np.eye(4)})
    assert [set(map(int, part)) for part in np.split(scene.cloud().labels, [20, 50])] == [
        {0, 1, 2, 4},
        {3},
        {5},
    ]


def test_functions_cannot_be_saved(tmp_path):
    camera = fs.Camera.pinhole(64, 48, 50, 50, 32, 24)
    scene = fs.Scene([], camera=camera, camera_motion=lambda time: np.eye(4))
    with pytest.raises(fs.InputError, match="motion of the camera must be an"):
        scene.save(tmp_path / "a.toml")
    moving = fs.Scene([fs.SplatCloud.empty()], cloud_motions={0: lambda time: np.eye(4)})
    with pytest.raises(fs.InputError, match="motion of cloud 0 must be an"):
        moving.save(tmp_path / "a.toml")
