"""The pinhole camera: projection, poses, and invalid arguments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fidsplat as fs
from fidsplat.cameras import focal_length, look_at_matrix
from fidsplat.splats.rotations import quaternion_to_matrix

coordinate = st.floats(-50, 50)
point = st.tuples(coordinate, coordinate, coordinate)


def test_pixel_centres():
    camera = fs.Camera.pinhole(5, 3, 100.0, 200.0, 2.5, 1.5)
    # the middle of an odd image is the centre of its middle pixel (row 1, column 2)
    assert camera.project([[0, 0, 1]]).tolist() == [[2.5, 1.5]]
    np.testing.assert_allclose(camera.project([[0.01, 0, 1], [0, 0.005, 1]]), [[3.5, 1.5], [2.5, 2.5]])


def test_any_principal_point():
    camera = fs.Camera.pinhole(641, 479, 500.0, 510.0, -30.25, 1000.75)
    np.testing.assert_allclose(camera.project([[1, 2, 4]]), [[500 / 4 - 30.25, 510 * 2 / 4 + 1000.75]])
    np.testing.assert_allclose(camera.matrix, [[500, 0, -30.25], [0, 510, 1000.75], [0, 0, 1]])


def test_nothing_behind_is_projected():
    camera = fs.Camera.pinhole(10, 10, 10, 10, 5, 5)
    projected = camera.project([[0, 0, -1], [0, 0, 0], [1, 1, 0], [0, 0, 1e-9]])
    assert np.isnan(projected).all(axis=1).tolist() == [True, True, True, False]
    assert camera.project(np.zeros((0, 3))).shape == (0, 2)


def test_look_at_by_default_has_y_down():
    camera = fs.Camera.look_at(640, 480, math.radians(90), [0, 0, -2], [0, 0, 0])
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(320), camera.fx, 320, 240)
    # a marker's frame: x right, y down, viewed from -z
    np.testing.assert_allclose(camera.project([[1, 0, 0], [0, 1, 0]]), [[480, 240], [320, 400]])
    np.testing.assert_allclose(camera.position, [0, 0, -2])


def test_look_at_with_z_up():
    camera = fs.Camera.look_at(100, 100, 1.0, [0, -3, 0], [0, 0, 0], up=[0, 0, 1])
    x, y = camera.project([[0.1, 0, 0.2]])[0]
    assert x > 50
    assert y < 50


EPSILON = np.finfo(float).eps


@given(point, point, point)
def test_look_at(position, target, up):
    try:
        matrix = look_at_matrix(position, target, up)
    except fs.InputError:
        forward = np.subtract(target, position)
        size = np.linalg.norm(np.cross(forward, up))
        assert size <= 1e-8 * np.linalg.norm(forward) * np.linalg.norm(up) + 1e-150
        return
    camera = fs.Camera.pinhole(101, 77, 80, 80, 50.5, 38.5, matrix)
    np.testing.assert_allclose(camera.position, position, atol=1e-12 + 1e-13 * np.abs(position).max())
    distance = np.linalg.norm(np.subtract(target, position))
    seen = matrix @ [*target, 1]
    # the axes are off by a rounding over the sine between the view and up, times the size of the coordinates
    forward, upward = (np.array(v) / math.hypot(*v) for v in (np.subtract(target, position), up))
    sine = math.hypot(*np.cross(forward, upward))
    size = np.abs([position, target]).max() + distance
    np.testing.assert_allclose(seen[:3], [0, 0, distance], rtol=1e-12, atol=8 * EPSILON * size / sine)
    along_up = matrix[:3, :3] @ (np.array(up) / np.linalg.norm(up))
    assert along_up[1] < 0
    assert abs(along_up[0]) < 1e-6


@given(st.floats(0.01, 3.1), st.integers(1, 9000))
def test_field_of_view(fov_x, width):
    camera = fs.Camera.look_at(width, 10, fov_x, [0, 0, 0], [0, 0, 1])
    edge = [[-math.tan(fov_x / 2), 0, 1], [math.tan(fov_x / 2), 0, 1]]
    np.testing.assert_allclose(camera.project(edge)[:, 0], [0, width], atol=1e-8 * width)


def test_a_rotated_and_moved_camera():
    rotation = quaternion_to_matrix(np.array([0.9, 0.1, -0.3, 0.2]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, [1, 2, 3]
    camera = fs.Camera.pinhole(640, 480, 500, 500, 320, 240, pose)
    world = np.array([[0.3, -0.2, 4.0]])
    seen = world[0] @ rotation.T + [1, 2, 3]
    np.testing.assert_allclose(camera.project(world)[0], 500 * seen[:2] / seen[2] + [320, 240])
    np.testing.assert_allclose(rotation @ camera.position + [1, 2, 3], 0, atol=1e-12)


def test_a_position_far_from_the_origin_is_exact():
    position = [500_000.125, 4_500_000.25, 300.5]
    camera = fs.Camera.look_at(64, 48, 1.0, position, [500_003, 4_500_001, 301])
    assert camera.position.tolist() == position
    assert camera.project([[500_003, 4_500_001, 301]])[0] == pytest.approx([32, 24], abs=1e-9)
    # a rotation that is orthonormal to float32 only: the transpose would be off by 0.3 m
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(np.array([0.9, 0.1, -0.3, 0.2])) * (1 + 1e-7)
    pose[:3, 3] = -pose[:3, :3] @ position
    camera = fs.Camera.pinhole(64, 48, 50, 50, 32, 24, pose)
    np.testing.assert_allclose(camera.position, position, atol=1e-8, rtol=0)


def test_a_position_of_another_pose():
    with pytest.raises(fs.InputError, match=r"position must be the centre of projection of world_to_camera"):
        fs.Camera.pinhole(64, 48, 50, 50, 32, 24, np.eye(4), position=(0, 0, 1))


POSED = fs.Camera.pinhole(
    64, 48, 90.0, 91.0, 20.0, 30.0, near=0.2, far=9.0, lens=fs.BrownConrady(k1=-0.1)
).with_pose(position=(1, 2, -3), target=(0, 0, 0))


def test_another_pose_by_a_matrix():
    matrix = look_at_matrix((3, 1, 2), (0, 0, 1))
    camera = POSED.with_pose(matrix)
    assert (camera.world_to_camera == matrix).all()
    np.testing.assert_allclose(camera.position, (3, 1, 2))
    for name in ("width", "height", "fx", "fy", "cx", "cy", "near", "far", "lens"):
        assert getattr(camera, name) == getattr(POSED, name)


def test_another_pose_by_position_and_target():
    far = (1e7 + 1 / 3, 5.0, -3.0)
    camera = POSED.with_pose(position=far, target=(1e7, 0, 0), up=(0, 0, 1))
    assert camera.position.tolist() == list(far)  # the pose has rounded it
    np.testing.assert_allclose(camera.world_to_camera, look_at_matrix(far, (1e7, 0, 0), (0, 0, 1)))
    moved = POSED.with_pose(position=(9, 9, 9))
    assert (moved.world_to_camera[:3, :3] == POSED.world_to_camera[:3, :3]).all()
    assert moved.position.tolist() == [9, 9, 9]
    turned = POSED.with_pose(target=(5, 5, 5))
    assert (turned.position == POSED.position).all()
    np.testing.assert_allclose(turned.project([[5, 5, 5]]), [[POSED.cx, POSED.cy]])


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ({}, "got none$"),
        ({"world_to_camera": np.eye(4), "position": (0, 0, 0)}, "got world_to_camera and position"),
        ({"world_to_camera": 2 * np.eye(4)}, "world_to_camera"),
        ({"position": (0, 0)}, "camera position must be three numbers"),
        ({"position": (0, 0, 1), "target": (0, 0, 1)}, "must be different points"),
    ],
)
def test_poses_that_are_refused(pose, words):
    with pytest.raises(fs.InputError, match=words):
        POSED.with_pose(**pose)


def test_frozen():
    pose = np.eye(4)
    camera = fs.Camera.pinhole(4, 4, 1, 1, 2, 2, pose)
    pose[0, 3] = 7
    assert camera.world_to_camera[0, 3] == 0
    with pytest.raises(ValueError, match="read-only"):
        camera.world_to_camera[0, 0] = 2
    with pytest.raises(AttributeError):
        camera.width = 5
    assert (camera.near, camera.far) == (0.01, math.inf)


GOOD = {"width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 32.0, "cy": 24.0}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"width": 0}, "width must be 1 to 32767 pixels, got 0"),
        ({"height": -3}, "height must be 1 to 32767"),
        ({"width": 32768}, "width must be 1 to 32767"),
        ({"height": 10**30}, "height must be 1 to 32767"),
        ({"width": 64.5}, "width must be a whole number"),
        ({"width": "64"}, "width must be a whole number"),
        ({"height": True}, "height must be a whole number"),
        ({"fx": 0.0}, "fx must be between 1e-06 and 1e[+]18 pixels, got 0.0"),
        ({"fy": -1.0}, "fy must be between"),
        ({"fx": math.inf}, "fx must be between .* got inf"),
        ({"fy": math.nan}, "fy must be between .* got nan"),
        ({"fx": 9e-7}, "fx must be between .* got 9e-07"),
        ({"fy": 1.1e18}, "fy must be between .* got 1.1e[+]18"),
        ({"fx": "wide"}, "fx must be a number"),
        ({"cx": math.nan}, "cx must be finite"),
        ({"cy": math.inf}, "cy must be finite"),
        ({"near": 0.0}, "near must be above 0"),
        ({"near": math.nan}, "near must be above 0"),
        ({"near": 1.0, "far": 1.0}, "far must be above near"),
        ({"far": math.nan}, "far must be above near"),
        ({"world_to_camera": np.eye(3)}, "world_to_camera must be a 4x4"),
        ({"world_to_camera": 2 * np.eye(4)}, "last row"),
        ({"world_to_camera": np.diag([2, 2, 2, 1])}, "world_to_camera must be rigid.*got scale 2"),
        ({"world_to_camera": np.diag([1, 1, -1, 1])}, "reflection"),
        ({"world_to_camera": np.diag([1, 2, 1, 1])}, "world_to_camera must be a rotation"),
        ({"world_to_camera": np.full((4, 4), np.nan)}, "world_to_camera must be finite"),
        ({"world_to_camera": "here"}, "4x4 matrix of numbers"),
    ],
)
def test_what_makes_no_camera(changes, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Camera.pinhole(**GOOD | changes)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0.0, [0, 0, 0], [0, 0, 1]), "fov_x must be between 0 and pi"),
        ((math.pi, [0, 0, 0], [0, 0, 1]), "fov_x must be between"),
        ((5e-324, [0, 0, 0], [0, 0, 1]), "fov_x must be between"),
        ((math.nan, [0, 0, 0], [0, 0, 1]), "fov_x must be between"),
        ((1.0, [0, 0, 1], [0, 0, 1]), "must be different points"),
        ((1.0, [0, 0], [0, 0, 1]), "position must be three"),
        ((1.0, [0, 0, 0], [0, 0, math.inf]), "look_at must be three"),
        ((1.0, [0, 0, 0], [0, 3, 0]), "up must not be parallel"),
        ((1.0, [0, 0, 0], [0, 0, 1], [0, 0, 0]), "up must not be zero"),
        ((1.0, [0, 0, 0], [0, 0, 1], "up"), "up must be three"),
    ],
)
def test_what_cannot_be_looked_at(arguments, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Camera.look_at(64, 48, *arguments)


def test_whole_numbers_of_numpy_and_the_largest_size():
    camera = fs.Camera.pinhole(np.int64(32767), np.uint8(1), 1, 1, 0, 0)
    assert (camera.width, type(camera.width), camera.height) == (32767, int, 1)
    assert focal_length(32767, math.pi / 2) == pytest.approx(32767 / 2)


def test_points_of_another_shape():
    with pytest.raises(fs.InputError, match=r"\(n, 3\).*\(3,\)"):
        fs.Camera.pinhole(**GOOD).project([1, 2, 3])
