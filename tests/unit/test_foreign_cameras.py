"""Cameras of COLMAP, nerfstudio and ROS, compared with pycolmap, OpenCV and rosbags; poses as pairs."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.splats.rotations import matrix_to_quaternion, rigid_matrix
from fidsplat.vision.truth import optical_flow

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3)) + np.array((0, 0, 2))
POSE = rigid_matrix(
    (0.1, -0.2, 0.3), np.array([0.98, 0.05, -0.1, 0.15]) / np.linalg.norm([0.98, 0.05, -0.1, 0.15])
)
PAIR = (POSE[:3, 3], matrix_to_quaternion(POSE[:3, :3]))
MODELS = {
    "SIMPLE_PINHOLE": [500, 321, 239],
    "PINHOLE": [500, 510, 321, 239],
    "SIMPLE_RADIAL": [500, 321, 239, 0.05],
    "RADIAL": [500, 321, 239, 0.05, -0.01],
    "OPENCV": [500, 510, 321, 239, 0.05, -0.01, 0.001, 0.002],
    "FULL_OPENCV": [500, 510, 321, 239, 0.05, -0.01, 0.001, 0.002, 0.003, 0.01, 0.02, 0.001],
    "OPENCV_FISHEYE": [500, 510, 321, 239, 0.05, -0.01, 0.001, 0.002],
    "SIMPLE_RADIAL_FISHEYE": [500, 321, 239, 0.05],
    "RADIAL_FISHEYE": [500, 321, 239, 0.05, -0.01],
}


@pytest.mark.parametrize("model", MODELS)
def test_cameras_of_colmap_project_as_pycolmap_does(model):
    pycolmap = pytest.importorskip("pycolmap")
    foreign = pycolmap.Camera(model=model, width=640, height=480, params=MODELS[model])
    pose = pycolmap.Rigid3d(POSE[:3])
    expected = foreign.img_from_cam(pose * POINTS)
    for camera in (
        fs.Camera.from_colmap(foreign, pose),
        fs.Camera.from_colmap((model, 640, 480, MODELS[model]), PAIR),
    ):
        np.testing.assert_allclose(camera.project(POINTS), expected, atol=1e-6)


def test_a_model_that_pycolmap_has_written(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="OPENCV", width=640, height=480, params=MODELS["OPENCV"], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a/first.png", camera_id=1, image_id=1)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(POSE[:3]))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write(tmp_path / "sparse" / "0")
    loaded = fs.load_cameras(tmp_path)
    assert list(loaded) == ["a/first.png"]
    np.testing.assert_allclose(loaded["a/first.png"].world_to_camera, POSE, atol=1e-12)
    again = fs.Camera.from_colmap(model.cameras[1], model.images[1])
    np.testing.assert_allclose(again.project(POINTS), loaded["a/first.png"].project(POINTS), atol=1e-9)


def _transforms():
    """Two frames by nerfstudio's conventions: camera to world, y up and z backwards."""
    poses = [np.linalg.inv(POSE) @ np.diag([1, -1, -1, 1]), np.diag([1.0, -1, -1, 1])]
    shared = {
        "w": 640,
        "h": 480,
        "fl_x": 500.0,
        "fl_y": 510.0,
        "cx": 321.0,
        "cy": 239.0,
        "k1": 0.05,
        "p1": 0.001,
    }
    frames = [
        {"file_path": f"images/{k}.png", "transform_matrix": pose.tolist()} for k, pose in enumerate(poses)
    ]
    return shared | {"camera_model": "OPENCV", "frames": frames}


def test_cameras_of_nerfstudio(tmp_path):
    transforms = _transforms()
    camera = fs.Camera.from_nerfstudio(transforms, "images/0.png")
    # OpenCV's pixel coordinates are smaller by 0.5
    k = np.array([[500, 0, 320.5], [0, 510, 238.5], [0, 0, 1]])
    rotation = cv2.Rodrigues(POSE[:3, :3])[0]
    pixels, _ = cv2.projectPoints(POINTS, rotation, POSE[:3, 3], k, np.array([0.05, 0, 0.001, 0, 0]))
    np.testing.assert_allclose(camera.project(POINTS), pixels[:, 0] + 0.5, atol=1e-6)
    np.testing.assert_array_equal(fs.Camera.from_nerfstudio(transforms, 1).world_to_camera, np.eye(4))
    (tmp_path / "transforms.json").write_text(json.dumps(transforms))
    loaded = fs.load_cameras(tmp_path / "transforms.json")
    assert list(loaded) == ["images/0.png", "images/1.png"] == list(fs.load_cameras(tmp_path))
    np.testing.assert_array_equal(loaded["images/0.png"].world_to_camera, camera.world_to_camera)


def test_focal_lengths_by_the_angles_of_both_axes():
    """As instant-ngp: each axis by its focal length or angle, the vertical one by default as the other."""
    angles = {"camera_angle_x": 2 * np.arctan(320 / 500), "camera_angle_y": 2 * np.arctan(240 / 510)}
    transforms = {key: value for key, value in _transforms().items() if not key.startswith("fl_")} | angles
    camera = fs.Camera.from_nerfstudio(transforms)
    np.testing.assert_allclose((camera.fx, camera.fy), (500, 510))
    del transforms["camera_angle_y"]
    camera = fs.Camera.from_nerfstudio(transforms)
    np.testing.assert_allclose((camera.fx, camera.fy), (500, 500))
    with pytest.raises(fs.InputError, match="camera_angle_y must be between"):
        fs.Camera.from_nerfstudio(transforms | {"camera_angle_y": 0})


def test_an_own_flight_is_read_back_as_cameras(tmp_path):
    camera = fs.Camera.pinhole(64, 48, 50.0, 51.0, 30.0, 25.0)
    poses = np.array([np.eye(4), np.linalg.inv(POSE)])
    fs.save_trajectory(fs.Trajectory([0, 1], poses), tmp_path / "t.json", camera, ["a.png", "b.png"])
    loaded = fs.load_cameras(tmp_path / "t.json")
    np.testing.assert_allclose(loaded["b.png"].world_to_camera, POSE, atol=1e-12)
    assert (loaded["a.png"].fy, loaded["a.png"].cx) == (51.0, 30.0)


def _camera_info(model, factors):
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    of = store.types
    stamp = of["builtin_interfaces/msg/Time"](0, 0)
    k = np.array([500.0, 0, 320.5, 0, 510.0, 238.5, 0, 0, 1])
    message = of["sensor_msgs/msg/CameraInfo"](
        header=of["std_msgs/msg/Header"](stamp, "optical"),
        height=480, width=640, distortion_model=model, d=np.array(factors, float), k=k, r=np.eye(3).ravel(),
        p=np.array([480.0, 0, 322.5, 0, 0, 481.0, 240.5, 0, 0, 0, 1, 0]),
        binning_x=0, binning_y=0, roi=of["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
    )  # fmt: skip
    kind = "sensor_msgs/msg/CameraInfo"
    return store.deserialize_cdr(store.serialize_cdr(message, kind), kind)


@pytest.mark.parametrize(
    ("model", "factors"),
    [
        ("plumb_bob", [0.05, -0.01, 0.001, 0.002, 0.003]),
        ("plumb_bob", []),
        ("rational_polynomial", [0.05, -0.01, 0.001, 0.002, 0.003, 0.01, 0.02, 0.001]),
        ("equidistant", [0.05, -0.01, 0.001, 0.002]),
    ],
)
def test_cameras_of_ros_project_as_opencv_does(model, factors):
    info = _camera_info(model, factors)
    camera = fs.Camera.from_ros_camera_info(info, PAIR)
    rotation, move, k = cv2.Rodrigues(POSE[:3, :3])[0], POSE[:3, 3], info.k.reshape(3, 3)
    if model == "equidistant":
        pixels = cv2.fisheye.projectPoints(POINTS[:, None], rotation, move, k, np.array(factors))[0][:, 0]
    else:
        pixels = cv2.projectPoints(POINTS, rotation, move, k, np.array(factors))[0][:, 0]
    np.testing.assert_allclose(camera.project(POINTS), pixels + 0.5, atol=1e-6)
    rectified = fs.Camera.from_ros_camera_info(info, rectified=True)
    assert (rectified.fx, rectified.cy, rectified.lens) == (480.0, 241.0, None)


def test_a_calibration_file_of_ros():
    file = {
        "image_width": 640, "image_height": 480, "camera_name": "left",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [500.0, 0, 320.5, 0, 510.0, 238.5, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.05, -0.01, 0.001, 0.002, 0.003]},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [500.0, 0, 0, 0, 0, 500, 0, 0, 0, 0, 1, 0]},
    }  # fmt: skip
    camera = fs.Camera.from_ros_camera_info(file)
    assert camera.matrix.tolist() == [[500, 0, 321], [0, 510, 239], [0, 0, 1]]
    assert camera.lens.k3 == 0.003


def _changed(**changes):
    return replace(_camera_info("plumb_bob", []), **changes)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: fs.Camera.from_colmap("sparse/0"), "fs.load_cameras reads files"),
        (lambda: fs.Camera.from_colmap(("FOV", 64, 48, [1, 2, 3, 4, 5])), "colmap image_undistorter"),
        (
            lambda: fs.Camera.from_colmap(("OPENCV", 64, 48, [50, 32, 24])),
            "parameters of COLMAP's model OPENCV",
        ),
        (lambda: fs.Camera.from_colmap(("PINHOLE", 64, 48, [50, 32, 24])), "must be fx, fy, cx, cy, got 3"),
        (
            lambda: fs.Camera.from_colmap(("RADIAL", 64, 48, [50, 51, 32, 24, 0.1, 0.0])),
            "must be f, cx, cy, k1, k2, got 6",
        ),
        (lambda: fs.Camera.from_nerfstudio("transforms.json"), "fs.load_cameras reads files"),
        (lambda: fs.Camera.from_nerfstudio(_transforms(), 2), "from 0 to 1 or a file_path.*got 2"),
        (lambda: fs.Camera.from_nerfstudio(_transforms() | {"w": "wide"}), "w and h must be"),
        (lambda: fs.Camera.from_ros_camera_info("info.yaml"), "must be a sensor_msgs/CameraInfo"),
        (lambda: fs.Camera.from_ros_camera_info(_changed(distortion_model="bob")), "distortion_model"),
        (lambda: fs.Camera.from_ros_camera_info(_changed(binning_x=2)), "got binning"),
        (lambda: fs.Camera.from_ros_camera_info(_changed(d=np.ones(8))), "rectify the images"),
        (lambda: fs.load_cameras("/nowhere"), "must be a transforms.json, or a folder"),
    ],
)
def test_what_is_no_camera(make, words):
    with pytest.raises(fs.InputError, match=words):
        make()


def test_a_store_is_placed_by_pairs(tmp_path):
    fs.save_ply(
        fs.marker("apriltag:36h11:5", size=0.16).gaussians.with_coplanar_groups(-1), tmp_path / "a.ply"
    )
    fs.build_store([tmp_path / "a.ply"], tmp_path / "a.fss")
    placed = fs.Store(fs.place_store(tmp_path / "a.fss", tmp_path / "b.fss", [PAIR, np.eye(4)]))
    np.testing.assert_allclose(placed.poses, [rigid_matrix(*PAIR), np.eye(4)], atol=1e-12)


def test_poses_are_matrices_or_pairs():
    camera = fs.Camera.pinhole(64, 48, 50, 50, 32, 24, PAIR)
    np.testing.assert_allclose(camera.world_to_camera, POSE, atol=1e-12)
    np.testing.assert_allclose(camera.camera_to_world, np.linalg.inv(POSE), atol=1e-12)
    moved = camera.with_pose(camera_to_world=PAIR)
    np.testing.assert_allclose(moved.camera_to_world, POSE, atol=1e-12)
    assert moved.position.tolist() == PAIR[0].tolist()
    np.testing.assert_allclose(camera.with_pose(np.concatenate(PAIR)).world_to_camera, POSE, atol=1e-12)
    tag = fs.marker("apriltag:36h11:5", size=0.16)
    np.testing.assert_allclose(PlacedMarker(tag, PAIR).pose, POSE, atol=1e-12)
    np.testing.assert_allclose(fs.Trajectory([0, 1], [PAIR, np.eye(4)])(0), POSE, atol=1e-12)
    np.testing.assert_array_equal(
        tag.cloud.transformed(PAIR).means, tag.cloud.transformed(rigid_matrix(*PAIR)).means
    )
    depth, label = np.ones((48, 64)), np.ones((48, 64), int)
    flows = [
        optical_flow(depth, camera, camera, label, {1: motion}) for motion in (PAIR, rigid_matrix(*PAIR))
    ]
    np.testing.assert_array_equal(*flows)
    motion = fs.Motion(lambda time: PAIR)
    np.testing.assert_allclose(motion.camera_at(0.0), POSE, atol=1e-12)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (((0, 0, 0), (0, 0, 0)), "a 4x4 matrix, or a position"),
        (((0, 0, 0), (1, 1, 0, 0)), "quaternion w, x, y, z of camera world_to_camera must have length 1"),
        (((0, 0, np.nan), (1, 0, 0, 0)), "a 4x4 matrix, or a position"),
        ([[1, 2], [3]], "camera world_to_camera"),
    ],
)
def test_pairs_that_are_no_poses(pose, words):
    with pytest.raises(fs.InputError, match=words):
        fs.Camera.pinhole(64, 48, 50, 50, 32, 24, pose)
    with pytest.raises(fs.InputError, match="got world_to_camera and camera_to_world"):
        fs.Camera.pinhole(64, 48, 50, 50, 32, 24).with_pose(np.eye(4), camera_to_world=np.eye(4))
