"""Cameras of SDF and URDF files."""

import math
from dataclasses import replace

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.sim import read_description
from fidsplat.sim.poses import compose, inverse, matrix_of

WORLD = """<sdf version="1.9"><world name="w">
  <include><uri>model://rover</uri><name>first</name><pose>1 2 0 0 0 1.5707963267948966</pose></include>
  <model name="mast"><pose>0 0 3 0 0 0</pose>
    <frame name="top" attached_to="pole"><pose>0 0 1 0 0 0</pose></frame>
    <link name="pole"><pose>0 0 0.5 0 0 0</pose></link>
    <link name="head"><pose relative_to="top" degrees="true">0 0 0.25 0 90 0</pose>
      <sensor name="depth" type="depth_camera"><camera>
        <image><width>64</width><height>48</height></image><horizontal_fov>1.2</horizontal_fov>
        <clip><near>0.2</near><far>30</far></clip></camera></sensor>
    </link>
  </model>
</world></sdf>"""

ROVER = """<sdf version="1.9"><model name="rover"><pose>9 9 9 0 0 0</pose>
  <link name="base"><pose>0 0 0.3 0 0 0</pose>
    <sensor name="imu" type="imu"/>
    <sensor name="front" type="camera"><pose>0.2 0 0.1 0 0 0</pose><update_rate>15</update_rate>
      <camera><pose>0 0 0 0.1 0.2 0.3</pose><horizontal_fov>1.0</horizontal_fov>
        <image><width>320</width><height>240</height><format>R8G8B8</format></image>
        <distortion><k1>-0.1</k1><k2>0.02</k2><p1>0.001</p1></distortion>
        <noise><type>gaussian</type><mean>0</mean><stddev>0.007</stddev></noise></camera></sensor>
  </link></model></sdf>"""

URDF = """<robot name="r">
  <link name="base"/><link name="arm"/><link name="wrist"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="arm"/>
    <origin xyz="0 0 1" rpy="0 0 1.5707963"/></joint>
  <joint name="b" type="fixed"><parent link="arm"/><child link="wrist"/><origin xyz="2 0 0"/></joint>
  <gazebo reference="wrist"><sensor name="eye" type="rgbd_camera"><pose>0 0 0.1 0 0 0</pose>
    <camera><horizontal_fov>1.5</horizontal_fov><image><width>100</width><height>80</height></image>
    <lens><type>equidistant</type></lens></camera></sensor></gazebo>
  <sensor name="own" type="camera" update_rate="20"><parent link="base"/><origin xyz="0 0 0.5"/>
    <camera><image width="64" height="48" format="RGB8" hfov="1.1" near="0.05" far="50"/></camera></sensor>
</robot>"""


@pytest.fixture
def world(tmp_path):
    (tmp_path / "models/rover").mkdir(parents=True)
    (tmp_path / "models/rover/model.sdf").write_text(ROVER)
    (tmp_path / "world.sdf").write_text(WORLD)
    return tmp_path / "world.sdf"


def in_the_world(description, name):
    """The camera of the description at the pose of its link."""
    camera = description.cameras[name]
    pose = compose(description.bodies[camera.body], camera.mount)
    return replace(camera.camera, world_to_camera=matrix_of(inverse(pose)), position=None)


def test_links_and_cameras_of_a_world(world):
    description = read_description(world, [world.parent / "models"])
    assert set(description.bodies) == {"first::base", "mast::pole", "mast::head"}
    np.testing.assert_allclose(description.bodies["first::base"][:3], [1, 2, 0.3], atol=1e-12)
    np.testing.assert_allclose(description.bodies["mast::head"][:3], [0, 0, 3 + 0.5 + 1 + 0.25], atol=1e-12)
    front, depth = description.cameras["front"], description.cameras["depth"]
    assert (front.body, depth.body) == ("first::base", "mast::head")
    assert (front.outputs, depth.outputs) == (("rgb",), ("depth",))
    assert (front.rate, depth.rate) == (15.0, None)
    assert (front.camera.width, front.camera.height) == (320, 240)
    assert front.camera.fx == pytest.approx(160 / math.tan(0.5))
    assert (front.camera.lens.k1, front.camera.lens.p1) == (-0.1, 0.001)
    assert (depth.camera.near, depth.camera.far) == (0.2, 30)
    assert front.sensor.read_noise / front.sensor.full_well == pytest.approx(0.007)


def test_a_sensor_looks_along_its_x_with_z_up(world):
    description = read_description(world, [world.parent / "models"])
    # the head is pitched by 90 degrees about y: its x is the world's -z, its z the world's x
    camera = in_the_world(description, "depth")
    below = [0, 0, 1.0]
    np.testing.assert_allclose(camera.project([below]), [[32, 24]], atol=1e-6)
    ((x, y),) = camera.project([[0.1, 0, 1.0]])
    assert y < 24  # the world's x is up in the image
    assert x == pytest.approx(32)
    assert camera.project([[0, 0.1, 1.0]])[0, 0] < 32  # its y is to the left


def test_roll_pitch_and_yaw_rotate_about_the_fixed_axes(world):
    description = read_description(world, [world.parent / "models"])
    r, p, y = 0.1, 0.2, 0.3
    turns = [
        np.array([[1, 0, 0], [0, math.cos(r), -math.sin(r)], [0, math.sin(r), math.cos(r)]]),
        np.array([[math.cos(p), 0, math.sin(p)], [0, 1, 0], [-math.sin(p), 0, math.cos(p)]]),
        np.array([[math.cos(y), -math.sin(y), 0], [math.sin(y), math.cos(y), 0], [0, 0, 1]]),
    ]
    optical = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    mount = matrix_of(description.cameras["front"].mount)
    np.testing.assert_allclose(mount[:3, :3], turns[2] @ turns[1] @ turns[0] @ optical, atol=1e-12)
    np.testing.assert_allclose(mount[:3, 3], [0.2, 0, 0.1], atol=1e-12)


def test_a_robot(tmp_path):
    (tmp_path / "robot.urdf").write_text(URDF)
    description = read_description(tmp_path / "robot.urdf")
    np.testing.assert_allclose(description.bodies["wrist"][:3], [0, 2, 1], atol=1e-6)
    eye, own = description.cameras["eye"], description.cameras["own"]
    assert (eye.body, eye.outputs, eye.camera.lens) == ("wrist", ("rgb", "depth"), fs.Fisheye())
    assert eye.camera.fx == pytest.approx(50 / 0.75)
    assert (own.body, own.rate, own.camera.near, own.camera.far) == ("base", 20.0, 0.05, 50)
    np.testing.assert_allclose(own.mount[:3], [0, 0, 0.5])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("model://rover", "model://rovr", "include model://rovr: cannot find the model in"),
        ('relative_to="top"', 'relative_to="tip"', r"unknown frame 'tip' \(did you mean 'top'"),
        ('attached_to="pole"', 'attached_to="top"', "'top' must not be relative to itself"),
        ("<width>64</width>", "<width>64.5</width>", "must be whole numbers of pixels, got 64.5"),
        ("<width>64</width>", "<width>wide</width>", "must be 1 finite number, got 'wide'"),
        ("<horizontal_fov>1.2<", "<horizontal_fov>3.2<", "depth/camera: camera fov_x must be between"),
        (
            'name="depth"',
            'name="front"',
            "two cameras have the name 'front', on mast::head and on first::base",
        ),
        ("0 0 0.25 0 90 0", "0 0 0.25", "must be 6 finite numbers, got '0 0 0.25'"),
        ('<sensor name="depth"', "<sensor", "a <sensor> must have a name"),
        ("<world", "<wrld", "as XML"),
        ("sdf", "sdff", "the root must be <sdf> or <robot>, got <sdff>"),
    ],
)
def test_files_that_cannot_be_used(world, old, new, words):
    assert old in WORLD
    world.write_text(WORLD.replace(old, new))
    with pytest.raises(fs.InputError, match=words) as raised:
        read_description(world, [world.parent / "models"])
    assert ".sdf: " in str(raised.value) or ".sdf as XML" in str(raised.value)


def test_a_model_that_includes_itself(tmp_path):
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop/model.sdf").write_text(
        '<sdf><model name="loop"><include><uri>model://loop</uri></include></model></sdf>'
    )
    with pytest.raises(fs.InputError, match="must not include itself"):
        read_description(tmp_path / "loop", [tmp_path])


def test_files_that_are_not_there_and_xacro(tmp_path):
    with pytest.raises(fs.InputError, match=r"cannot read .*none\.sdf"):
        read_description(tmp_path / "none.sdf")
    with pytest.raises(fs.InputError, match=r"a path must be text without NUL, or a pathlib\.Path, got 5"):
        read_description(5)  # type: ignore[arg-type]
    (tmp_path / "r.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="r"><xacro:property name="a"/></robot>'
    )
    with pytest.raises(fs.InputError, match="must be URDF, got xacro; run `xacro"):
        read_description(tmp_path / "r.xacro")
