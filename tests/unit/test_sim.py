"""Rigs: bodies, cameras and environments, as plain arrays."""

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.sim import Rig, RigCamera
from fidsplat.sim.poses import compose, inverse, matrix_of, pose_of
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.vision import read_back

SIZE = 160, 120
RNG = np.random.default_rng(19)


def a_pose(move=0.2, turn=0.3):
    quaternion = np.array([1.0, *RNG.uniform(-turn, turn, 3)])
    return np.array([*RNG.uniform(-move, move, 3), *(quaternion / np.linalg.norm(quaternion))])


@pytest.fixture(scope="module")
def renderer():
    return fs.Renderer("reference")  # which compiles nothing


@pytest.fixture(scope="module")
def scene():
    tag = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.4), rigid_matrix((0.05, 0, 0)))
    wall = fs.SplatCloud([[0, 0, 3.0]], [[1, 0, 0, 0]], [[1.0, 1.0]], [0.9], colors=[[0.2, 0.4, 0.6]])
    return fs.Scene([wall], markers=[tag], outputs=("rgb", "label"))


@pytest.fixture(scope="module")
def rig(scene, renderer):
    return a_rig(scene, renderer)


def a_rig(scene, renderer):
    camera = fs.Camera.pinhole(*SIZE, 150, 150, 80, 60)
    on_robot = fs.Camera.pinhole(*SIZE, 150, 150, 80, 60, rigid_matrix((0.1, 0, 0.2)))
    cameras = {"fixed": camera, "mounted": RigCamera(on_robot, body="robot")}
    return Rig(scene, {1: "box"}, cameras, renderer=renderer)


def some_poses(count):
    box = np.stack([compose(np.array([0, 0, 1.5, 1, 0, 0, 0.0]), a_pose()) for _ in range(count)])
    return {"box": box, "robot": np.stack([a_pose(0.1, 0.05) for _ in range(count)])}


def test_poses_compose_and_invert_as_matrices_do():
    a, b = np.stack([a_pose(), a_pose()]), np.stack([a_pose(), a_pose()])
    np.testing.assert_allclose(matrix_of(compose(a, b)), matrix_of(a) @ matrix_of(b), atol=1e-15)
    np.testing.assert_allclose(matrix_of(inverse(a)), np.linalg.inv(matrix_of(a)), atol=1e-15)
    np.testing.assert_allclose(pose_of(matrix_of(a[0])), a[0], atol=1e-15)


def test_an_environment_is_bit_identical_in_any_batch(scene):
    rig = a_rig(scene, fs.Renderer("opencl:pocl"))
    poses = some_poses(3)
    many = rig.render(poses)
    assert many["rgb"].shape == (3, 2, SIZE[1], SIZE[0], 3)
    for i in range(3):
        alone = rig.render({name: pose[i : i + 1] for name, pose in poses.items()})
        for name in ("rgb", "label"):
            assert many[name][i].tobytes() == alone[name][0].tobytes()
    assert not np.array_equal(many["rgb"][0], many["rgb"][1])


def test_a_marker_is_read_where_its_body_is_by_a_fixed_camera_and_by_one_that_moves(rig):
    poses = some_poses(2)
    images = rig.render(poses)
    for camera in ("fixed", "mounted"):
        for i in range(2):
            there = matrix_of(poses["box"][i]) @ rigid_matrix((0.05, 0, 0))
            np.testing.assert_allclose(images.placed(i)[0].pose, there, atol=1e-12)
            (reading,) = read_back(images.of(camera).frame(i), rig.scene).readings
            np.testing.assert_allclose(reading.placed.pose, there, atol=1e-12)
            assert reading.position_error < 0.01, (camera, i)
            assert reading.corner_error < 0.1
    robot = matrix_of(poses["robot"][1]) @ np.linalg.inv(rigid_matrix((0.1, 0, 0.2)))
    np.testing.assert_allclose(images.camera("mounted", 1).world_to_camera, np.linalg.inv(robot), atol=1e-12)


def test_cameras_off_the_origin_have_the_images_of_a_scene_put_together_by_hand(scene, renderer):
    """Pixels that are not square, a principal point aside, a camera mounted askew, and splats out of view."""
    rng = np.random.default_rng(3)
    mount = rigid_matrix((0.3, -0.2, 0.1), (0.9, 0.1, -0.05, 0.2))
    base = rigid_matrix((1.0, -0.7, -2.0), (0.95, -0.05, 0.2, 0.1))
    around = rng.uniform(-4, 4, (200, 3))  # most of them next to the image or behind it
    sizes = rng.uniform(0.02, 0.2, (200, 2))
    cloud = fs.SplatCloud(
        around, rng.normal(size=(200, 4)), sizes, rng.random(200), sh=0.3 * rng.normal(size=(200, 9, 3))
    )
    composed = fs.Scene([cloud], markers=scene.markers)

    def seen_from(eye):
        return fs.Camera.pinhole(*SIZE, 150, 190, 70, 66, np.linalg.inv(eye))

    cameras = {"fixed": seen_from(base), "mounted": RigCamera(seen_from(mount), body="robot")}
    own = Rig(composed, {1: "box"}, cameras, renderer=renderer, outputs=("rgb", "depth"))
    poses = {"box": np.stack([a_pose() for _ in range(2)])}
    poses["robot"] = np.stack([compose(pose_of(base), a_pose(0.1, 0.05)) for _ in range(2)])
    images = own.render(poses)
    for i in range(2):
        (tag,) = scene.markers
        placed = PlacedMarker(tag.marker, matrix_of(poses["box"][i]) @ tag.pose)
        eyes = {"fixed": base, "mounted": matrix_of(poses["robot"][i]) @ mount}
        for name, eye in eyes.items():
            alone = fs.Scene([cloud], seen_from(eye), [placed])
            expected = renderer.render(alone, outputs=("rgb", "depth"))
            assert (expected["rgb"] > 0).any(axis=2).mean() > 0.05
            frame = images.of(name).frame(i)
            for output, off in (("rgb", 1e-5), ("depth", 1e-4)):
                wrong = np.abs(frame[output] - expected[output]) > off
                assert wrong.mean() < 2e-3, (name, i, output)  # float32 poses at thresholds


def test_arrays_in_the_rigs_order_say_the_same_as_names(rig):
    poses = some_poses(1)
    assert rig.bodies == ("box", "robot")
    stacked = np.stack([poses[name] for name in rig.bodies], axis=1)
    assert rig.render(stacked)["rgb"].tobytes() == rig.render(poses)["rgb"].tobytes()


def test_a_camera_that_is_given_a_pose_has_it_on_any_body(rig):
    poses = some_poses(1)
    images = rig.render(poses, {"mounted": [[0, 0, 0, 1, 0, 0, 0]]})
    assert images["rgb"][0, 1].tobytes() == images["rgb"][0, 0].tobytes()


def test_bodies_at_rest_where_the_scene_has_their_splats(scene, renderer):
    rest = a_pose()
    moved = scene.markers[0].pose.copy()
    moved = matrix_of(rest) @ moved
    placed = fs.Scene(scene.clouds, markers=[PlacedMarker(scene.markers[0].marker, moved)])
    camera = {"fixed": fs.Camera.pinhole(*SIZE, 150, 150, 80, 60)}
    at_rest = Rig(placed, {1: "box"}, camera, renderer=renderer, rest={"box": rest}, outputs="label")
    in_frame = Rig(scene, {1: "box"}, camera, renderer=renderer, outputs="label")
    pose = {"box": compose(np.array([0, 0, 1.5, 1, 0, 0, 0.0]), a_pose())[None]}
    one, other = at_rest.render(pose), in_frame.render(pose)
    assert (one["label"] != other["label"]).mean() < 1e-3  # float32 of another place
    np.testing.assert_allclose(one.placed()[0].pose, other.placed()[0].pose, atol=1e-12)


def test_each_environment_has_its_own_external_depth_image(scene):
    camera = {"fixed": fs.Camera.pinhole(*SIZE, 150, 150, 80, 60)}
    rig = Rig(scene, {1: "box"}, camera, renderer=fs.Renderer("reference"), outputs=("label",))
    box = np.tile([0, 0, 1.5, 1, 0, 0, 0.0], (2, 1))
    near, far = (
        fs.ExternalDepth(np.zeros((*SIZE[::-1], 3)), np.full(SIZE[::-1], depth), label=9)
        for depth in (1.0, 2.0)
    )
    label = rig.render({"box": box}, external_depths={"fixed": [near, far]})["label"][:, 0]
    assert set(np.unique(label[0])) == {9}
    assert set(np.unique(label[1])) == {1, 9}
    with pytest.raises(fs.InputError, match=r"must have 2 images, got 1"):
        rig.render({"box": box}, external_depths={"fixed": [near]})
    with pytest.raises(fs.InputError, match="unknown camera 'fxed'"):
        rig.render({"box": box}, external_depths={"fxed": [near, far]})
    with pytest.raises(fs.InputError, match=r"external_depths\['fixed'\] must be a list"):
        rig.render({"box": box}, external_depths={"fixed": near})
    with pytest.raises(fs.InputError, match=r"external_depths must be .*, got \["):
        rig.render({"box": box}, external_depths=[near, far])


def test_masked_environments_are_not_rendered(rig):
    poses = some_poses(2)
    images = rig.render(poses, mask=np.array([False, True]))
    assert not images["rgb"][0].any()
    assert (images["label"][0] == -1).all()
    assert (images["label"][1] == 1).any()


def test_noise_is_another_in_every_environment_and_step(scene, renderer):
    camera = RigCamera(fs.Camera.pinhole(32, 24, 30, 30, 16, 12), sensor=fs.Sensor(full_well=500.0))
    box = {"box": np.tile([0, 0, 1.5, 1, 0, 0, 0.0], (2, 1))}

    def rig():
        return Rig(scene, {1: "box"}, {"noisy": camera}, renderer=renderer, outputs="rgb")

    one = rig()
    first, second = one.render(box)["rgb"], one.render(box)["rgb"]
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], second[0])
    assert first.tobytes() == rig().render(box)["rgb"].tobytes()


def test_cameras_of_different_sizes_are_taken_one_by_one(scene, renderer):
    cameras = {
        "a": fs.Camera.pinhole(*SIZE, 150, 150, 80, 60),
        "b": fs.Camera.pinhole(64, 48, 60, 60, 32, 24),
    }
    images = Rig(scene, {1: "box"}, cameras, renderer=renderer).render({"box": [[0, 0, 1.5, 1, 0, 0, 0]]})
    assert images.of("b")["label"].shape == (1, 48, 64)
    with pytest.raises(fs.InputError, match=r"one size, got several; .*images.of\('a'\)"):
        _ = images["rgb"]


GOOD = np.array([[0, 0, 1.5, 1, 0, 0, 0.0]])


@pytest.mark.parametrize(
    ("bodies", "cameras", "words"),
    [
        ({"bxo": GOOD, "robot": GOOD}, None, r"unknown body 'bxo' \(did you mean 'box'\?\)"),
        (
            {"box": GOOD, "robot": GOOD},
            {"mountde": GOOD},
            r"unknown camera 'mountde' \(did you mean 'mounted'",
        ),
        ({"box": GOOD}, None, "got none for 'robot'"),
        ({"box": GOOD * np.nan, "robot": GOOD}, None, "must have finite numbers"),
        ({"box": GOOD * 2, "robot": GOOD}, None, "must have a quaternion .* of length 1, got .* of length 2"),
        ({"box": GOOD[0], "robot": GOOD}, None, r"must have the shape \(env, 7\), got \(7,\)"),
        ({"box": GOOD, "robot": np.tile(GOOD, (3, 1))}, None, "poses of 1 environments .*, got 3"),
        (np.tile(GOOD, (2, 3, 1)), None, r"must have .* for each body of the rig \(box, robot\), got 3"),
        ("box", None, "must be poses"),
    ],
)
def test_poses_that_cannot_be_used(rig, bodies, cameras, words):
    with pytest.raises(fs.InputError, match=words):
        rig.render(bodies, cameras)


@pytest.mark.parametrize(
    ("bodies", "cameras", "words"),
    [
        ({7: "box"}, {"a": 0}, "the label of the body 'box' must be .*, got 7; known: 0, 1"),
        ({"box": 1}, {"a": 0}, "label of splats: name of the body"),
        ({1: "box"}, [("a", 0), ("a", 0)], "must be unique, got 'a' twice"),
        ({1: "box"}, {}, "cameras must have at least one camera, got none"),
        ({1: "box"}, {"a": "wide"}, "camera must be a Camera, got 'wide'"),
        ({1: "box"}, 3, "cameras must be .*, got 3"),
    ],
)
def test_rigs_that_cannot_be(scene, renderer, bodies, cameras, words):
    camera = fs.Camera.pinhole(*SIZE, 150, 150, 80, 60)
    if isinstance(cameras, dict):
        cameras = {name: camera if value == 0 else value for name, value in cameras.items()}
    elif isinstance(cameras, list):
        cameras = [(name, camera) for name, _ in cameras]
    with pytest.raises(fs.InputError, match=words):
        Rig(scene, bodies, cameras, renderer=renderer)


def test_a_scene_that_moves_by_itself_is_refused(scene, renderer):
    moving = fs.Scene(scene.clouds, cloud_motions={0: lambda time: np.eye(4)})
    with pytest.raises(fs.InputError, match="the simulator moves the bodies"):
        Rig(moving, cameras={"a": fs.Camera.pinhole(*SIZE, 150, 150, 80, 60)}, renderer=renderer)
