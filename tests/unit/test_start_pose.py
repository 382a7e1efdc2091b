"""The camera that a scene starts with: the guessed up axis, and --up, --position, --look-at and --size."""

import json
import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cli import main
from fidsplat.commands.view import View
from fidsplat.images.files import read_image, to_uint8
from fidsplat.scenes import PlacedMarker
from fidsplat.scenes.sources import StartPose, framing_camera, load_source
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.splats.statistics import describe

AXES = {"+z": (0, 0, 1), "-z": (0, 0, -1), "+y": (0, 1, 0), "-y": (0, -1, 0), "+x": (1, 0, 0)}


def yard(up, thin=None):
    """A ground of 4 x 4 m at 0 with a post of 1 m, for an up axis, and a z up frame of it.

    thin: thickness, which makes 3D Gaussians whose shortest axis is the first one.
    """
    generator = np.random.default_rng(0)
    up, right = np.array(up, float), np.roll(up, 1)
    frame = np.stack([right, np.cross(up, right), up], 1)
    ground = generator.uniform(-2, 2, (400, 3)) * [1, 1, 0.01]
    post = generator.uniform(-1, 1, (60, 3)) * [0.05, 0.05, 0.5] + [0.5, 0, 0.5]
    level, wall = (frame, frame[:, [2, 0, 1]])[:: 1 if thin is None else -1]
    quats = [matrix_to_quaternion(level)] * 400 + [matrix_to_quaternion(wall)] * 60
    scales = np.full((460, 3), 0.1)
    scales[:, 2 if thin is None else 0] = thin or 0.0
    colors = np.array([(0.2, 0.7, 0.3)] * 400 + [(0.9, 0.2, 0.1)] * 60)
    means = np.concatenate([ground, post]) @ frame.T
    return fs.SplatCloud(
        means, quats, scales[:, : 2 if thin is None else 3], np.full(460, 0.9), colors=colors
    )


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("thin", [None, 0.01])
def test_a_scene_starts_upright_and_above_its_ground(axis, thin):
    up = np.array(AXES[axis], float)
    cloud = yard(up, thin)
    camera = framing_camera(cloud)
    assert camera.position @ up > 0.5
    assert -camera.world_to_camera[1, :3] @ up > 0.9  # image up
    foot, top = camera.project(np.array([0.0, 1.0])[:, None] * up)
    assert foot[1] > top[1] + 50
    assert abs(camera.world_to_camera[0, :3] @ up) < 1e-12  # no roll
    inside = camera.project(cloud.means)
    assert ((inside > 0) & (inside < (1280, 720))).all()


@pytest.mark.parametrize("axis", ["+z", "+y", "-y"])
def test_the_suggested_marker_faces_the_first_view(axis):
    cloud = yard(AXES[axis])
    facts = describe(cloud)
    pose = (facts["marker_position"], facts["marker_quaternion"])
    placed = PlacedMarker(fs.marker("apriltag:36h11:5", size=facts["marker_size"]), pose)
    camera = framing_camera(cloud)
    corners = camera.project(placed.corners)
    (left_top, right_top, right_bottom, left_bottom) = corners  # upright, not mirrored
    assert left_top[0] < right_top[0] - 20
    assert left_top[1] < left_bottom[1] - 20
    assert right_bottom[0] > left_bottom[0] + 20
    distances = (cloud.means - camera.position) @ camera.world_to_camera[2, :3]
    assert (placed.pose[:3, 3] - camera.position) @ camera.world_to_camera[2, :3] < np.median(distances)


def test_a_marker_and_a_cloud_without_ground_are_framed_from_the_front():
    random = np.random.default_rng(1)
    quats = random.normal(size=(50, 4))
    shapeless = fs.SplatCloud(
        random.uniform(-1, 1, (50, 3)), quats, np.full((50, 2), 0.05), np.ones(50), colors=np.ones((50, 3))
    )
    for cloud in (fs.marker("qr:front", size=0.2).cloud, shapeless):
        np.testing.assert_array_equal(framing_camera(cloud).world_to_camera[:3, :3], np.eye(3))
    # an option overrides the guess, also with an axis between x, y and z
    tilted = framing_camera(shapeless, StartPose(up=(0, 1, 2)))
    assert -tilted.world_to_camera[1, :3] @ (0, 1, 2) / math.sqrt(5) == pytest.approx(
        math.cos(math.radians(15))
    )


def test_a_store_starts_like_its_splats(tmp_path):
    cloud = yard((0, 0, 1))
    fs.save_ply(cloud, tmp_path / "yard.ply")
    fs.build_store([tmp_path / "yard.ply"], tmp_path / "yard.fss")
    store, own = framing_camera(fs.Store(tmp_path / "yard.fss")), framing_camera(cloud)
    np.testing.assert_allclose(store.world_to_camera[:3, :3], own.world_to_camera[:3, :3])


SCENE = """[camera]
width = 64
height = 48
fx = 60.0
fy = 50.0
cx = 30.0
cy = 26.0
position = [0.0, -5.0, 1.0]
look_at = [0.0, 0.0, 1.0]
up = [0.0, 0.0, 1.0]
[[splats]]
file = "yard.ply"
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fs.save_ply(yard((0, 0, 1)), "yard.ply")
    (tmp_path / "yard.toml").write_text(SCENE)
    return tmp_path


def test_render_takes_its_camera_from_options(here, capsys):
    words = ["--up", "0", "0", "1", "--position", "-3", "-1", "2", "--look-at", "0", "0", "0.5"]
    words += ["--size", "64", "48", "--device", "reference", "--json"]
    assert main(["render", "yard.ply", "-o", "posed.png", *words]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["width"], facts["height"]) == (64, 48)
    camera = fs.Camera.look_at(64, 48, math.radians(60), (-3, -1, 2), (0, 0, 0.5), (0, 0, 1))
    image = fs.Renderer("reference").render(fs.load_ply("yard.ply"), camera)["rgb"]
    np.testing.assert_array_equal(read_image("posed.png"), to_uint8(image))


@pytest.mark.usefixtures("here")
def test_options_change_only_what_they_name():
    scene = load_source("yard.toml", pose=StartPose(position=(1, -5, 1)), size=(128, 100))
    camera = scene.camera
    np.testing.assert_allclose(camera.position, (1, -5, 1))
    np.testing.assert_allclose(camera.world_to_camera[2, :3], (0, 1, 0), atol=1e-12)  # the direction stays
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (120.0, 100.0, 60.0, 54.0)
    rolled = load_source("yard.toml", pose=StartPose(up=(1, 0, 0))).camera
    np.testing.assert_allclose(-rolled.world_to_camera[1, :3], (1, 0, 0), atol=1e-12)
    splats = load_source("yard.ply", pose=StartPose(position=(0, -9, 3))).camera
    assert abs(splats.project([[0, 0, 0.5]])[0] - (640, 360)).max() < 60  # towards the middle


def test_a_moving_camera_stays_at_the_pose_of_the_options(here):
    motion = "".join(
        f"[[camera.motion]]\ntime = {t}.0\nposition = [{t}.0, -5.0, 1.0]\nlook_at = [{t}.0, 0.0, 1.0]\n"
        "up = [0.0, 0.0, 1.0]\n"
        for t in (0, 1)
    )
    still = SCENE.split("position = ")[0] + motion + "[camera.shutter]\ntime = 0.5\n"
    (here / "yard.toml").write_text(still + SCENE[SCENE.index("[[splats]]") :])
    scene = load_source("yard.toml", pose=StartPose(look_at=(0.5, 0, 0)))
    camera = scene.capture.motion.moved(scene.camera, 0.5)
    np.testing.assert_allclose(camera.position, (0.5, -5, 1), atol=1e-9)
    np.testing.assert_allclose(camera.project([[0.5, 0, 0]]), [[camera.cx, camera.cy]])
    assert load_source("yard.toml").camera_motion is not None


def test_panoramas_keep_their_sphere_at_another_size():
    camera = fs.Camera.equirectangular(64, 32).with_size(100, 80)
    same = fs.Camera.equirectangular(100, 80)
    np.testing.assert_allclose(camera.matrix, same.matrix)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--up", "0", "0", "0"), "camera up must be three finite numbers, not all 0"),
        (("--position", "nan", "0", "0"), "camera position must be three finite numbers"),
        (("--position", "0", "0", "1", "--look-at", "0", "0", "1"), "must be different points"),
        (("--size", "0", "48"), "camera width must be 1 to 32767 pixels"),
    ],
)
def test_poses_that_are_none(here, words, says, capsys):
    assert main(["render", "yard.ply", *words]) == 2
    assert says in capsys.readouterr().err


def test_fly_and_view_render_the_same_image_from_a_pose(here):
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.session import Session
    from fidsplat.viewer.settings import Viewpoint

    start = (
        View("yard.ply")
        ._target()
        .scene(None, lambda step, fraction: None, StartPose(look_at=(0, 0, 1)))
        .camera
    )
    pose = np.linalg.inv(start.world_to_camera)
    w, x, y, z = quaternion = matrix_to_quaternion(pose[:3, :3])
    (here / "one.tum").write_text(" ".join(map(repr, map(float, (0, *pose[:3, 3], x, y, z, w)))) + "\n")
    words = ["--trajectory", "one.tum", "--size", "32", "18", "--device", "reference", "-o", "flight"]
    assert main(["fly", "yard.ply", *words]) == 0
    session = Session(load_source("yard.ply"), "reference")
    fov_y = 2 * math.atan(start.height / 2 / start.fy)
    viewed = session.render(Viewpoint(tuple(pose[:3, 3]), tuple(quaternion), fov_y, 32, 18)).frame
    session.close()
    flown = read_image("flight/rgb/000000.png").astype(int)
    assert flown.max() > 100
    assert np.abs(flown - viewed.to_uint8()).max() <= 1  # rounding of the pose


def test_the_page_rotates_about_the_vertical():
    pytest.importorskip("viser", reason="the extra viewer is not installed")
    from fidsplat.viewer.server import _upright

    down = fs.Camera.look_at(64, 48, 1.0, (3, -4, 5), (0, 0, 0), (0, 0, 1))
    np.testing.assert_array_equal(_upright(np.linalg.inv(down.world_to_camera)), (0, 0, 1))
    rolled = fs.Camera.look_at(64, 48, 1.0, (3, -4, 5), (0, 0, 0), (0.2, 0.3, 1))
    pose = np.linalg.inv(rolled.world_to_camera)
    np.testing.assert_array_equal(_upright(pose), -pose[:3, 1])
