"""Files of other writers with features that ours lack: strides, units, axes, encodings, frames."""

import json
import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.images.files import write_png
from fidsplat.sim import read_description
from fidsplat.splats.rotations import quaternion_multiply, quaternion_to_matrix, rigid_matrix
from fidsplat.train.dataset_files import load_dataset

RANDOM = np.random.default_rng(5)
COUNT = 6
MEANS = RANDOM.normal(size=(COUNT, 3)).astype(np.float32)
QUATS = RANDOM.normal(size=(COUNT, 4))
QUATS /= np.linalg.norm(QUATS, axis=1, keepdims=True)
SCALES = RANDOM.uniform(0.1, 0.5, (COUNT, 3)).astype(np.float32)
OPACITIES = RANDOM.uniform(0.2, 0.9, COUNT).astype(np.float32)
COLORS = RANDOM.uniform(-1, 1, (COUNT, 3)).astype(np.float32)
TURN = np.array([0.8, 0.1, -0.4, 0.3]) / np.linalg.norm([0.8, 0.1, -0.4, 0.3])
MOVE = np.array([1.0, -2.0, 3.0])
HALF_TURN = np.diag([1.0, -1.0, -1.0])  # from y up to y down, as splats are


def assert_placed(cloud, turn, move, scale, atol=2e-6):
    """The splats of above, scaled, turned (3, 3) and moved (3,)."""
    np.testing.assert_allclose(cloud.world_means(), scale * MEANS @ turn.T + move, atol=atol)
    ours = quaternion_to_matrix(cloud.quats)
    three = np.column_stack([cloud.scales, cloud.thickness])
    actual = ours * (three**2)[:, None, :] @ ours.swapaxes(1, 2)
    theirs = turn @ quaternion_to_matrix(QUATS)
    expected = theirs * ((scale * SCALES) ** 2)[:, None, :] @ theirs.swapaxes(1, 2)
    np.testing.assert_allclose(actual, expected, atol=atol)
    np.testing.assert_allclose(cloud.opacities, OPACITIES, atol=1e-6)
    np.testing.assert_allclose(cloud.sh[:, 0], COLORS, atol=1e-6)


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
def test_a_gltf_of_pygltflib_with_a_matrix_and_rows_that_interleave(tmp_path, suffix):
    gltf = pytest.importorskip("pygltflib", reason="pip install 'fidsplat[test]'")
    parts = [MEANS, QUATS[:, [1, 2, 3, 0]], SCALES, COLORS, OPACITIES[:, None], np.full((COUNT, 2), 9.0)]
    rows = np.column_stack(parts).astype("<f4")  # and two floats that no one names
    names = [
        "POSITION",
        *(f"KHR_gaussian_splatting:{n}" for n in ("ROTATION", "SCALE", "SH_DEGREE_0_COEF_0")),
    ]
    names.append("KHR_gaussian_splatting:OPACITY")
    accessors, at = [], 0
    for part in parts[:-1]:
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[part.shape[1]]
        accessor = {"bufferView": 0, "byteOffset": at, "componentType": 5126, "count": COUNT, "type": kind}
        accessors.append(gltf.Accessor(**accessor))
        at += 4 * part.shape[1]
    matrix = rigid_matrix(MOVE, TURN, 2.5).T.ravel().tolist()  # by columns
    primitive = gltf.Primitive(
        attributes=gltf.Attributes(**{name: k for k, name in enumerate(names)}),
        extensions={"KHR_gaussian_splatting": {"kernel": "ellipse"}},
        mode=0,
    )
    document = gltf.GLTF2(
        scenes=[gltf.Scene(nodes=[0])],
        scene=0,
        nodes=[gltf.Node(children=[1], translation=[0.0, 0.0, 7.0]), gltf.Node(mesh=0, matrix=matrix)],
        meshes=[gltf.Mesh(primitives=[primitive])],
        accessors=accessors,
        bufferViews=[
            gltf.BufferView(buffer=0, byteOffset=0, byteLength=rows.nbytes, byteStride=4 * rows.shape[1])
        ],
        buffers=[gltf.Buffer(byteLength=rows.nbytes)],
    )
    document.set_binary_blob(rows.tobytes())
    document.save(str(tmp_path / f"a{suffix}"))
    axes = np.diag([-1.0, -1.0, 1.0])  # glTF has x to the left, y up and z forward
    turn = axes @ quaternion_to_matrix(TURN)
    move = axes @ np.add(MOVE, (0, 0, 7))
    assert_placed(fs.load_splats(tmp_path / f"a{suffix}"), turn, move, 2.5)


@pytest.mark.parametrize(("up", "metres"), [("Z", 0.01), ("Y", 0.01), ("Z", None)])
def test_a_usd_stage_in_other_units_and_with_another_axis_up(tmp_path, up, metres):
    pytest.importorskip("pxr.UsdVol", reason="pip install 'fidsplat[usd]'")
    from pxr import Gf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateNew(str(tmp_path / "a.usda"))
    UsdGeom.SetStageUpAxis(stage, up)
    if metres is not None:
        UsdGeom.SetStageMetersPerUnit(stage, metres)
    above = UsdGeom.Xform.Define(stage, "/world")
    above.AddTranslateOp().Set(Gf.Vec3d(*MOVE))
    above.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*TURN.tolist()))
    prim = stage.DefinePrim("/world/field", "ParticleField3DGaussianSplat")
    for name, value in {
        "positions": Vt.Vec3fArray.FromNumpy(MEANS),
        "scales": Vt.Vec3fArray.FromNumpy(SCALES),
        "orientations": Vt.QuatfArray([Gf.Quatf(*map(float, q)) for q in QUATS]),
        "opacities": Vt.FloatArray.FromNumpy(OPACITIES),
        "radiance:sphericalHarmonicsDegree": 0,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(COLORS),
    }.items():
        prim.GetAttribute(name).Set(value)
    stage.GetRootLayer().Save()
    scale = 1.0 if metres is None else metres
    axes = HALF_TURN if up == "Y" else np.eye(3)
    cloud = fs.load_splats(tmp_path / "a.usda")
    assert_placed(cloud, axes @ quaternion_to_matrix(TURN), scale * axes @ MOVE, scale)


PIXELS = RANDOM.integers(0, 256, (5, 7, 4), np.uint8)


@pytest.mark.parametrize(
    ("encoding", "order"),
    [
        ("rgb8", [0, 1, 2]),
        ("bgr8", [2, 1, 0]),
        ("rgba8", [0, 1, 2, 3]),
        ("bgra8", [2, 1, 0, 3]),
        ("mono8", [0]),
    ],
)
def test_encodings_of_images_in_a_bag_of_rosbags(tmp_path, encoding, order):
    """Rows longer than their pixels, too."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2", reason="pip install 'fidsplat[logs]'")
    from fidsplat.logs import log_images
    from fidsplat.logs.writers import typestore

    store = typestore()
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](3, 7), "eye")
    rows = np.concatenate([PIXELS[..., order].reshape(5, -1), np.full((5, 3), 99, np.uint8)], axis=1)
    message = store.types["sensor_msgs/msg/Image"](header, 5, 7, encoding, 0, rows.shape[1], rows.ravel())
    with rosbag2.Writer(tmp_path / "bag", version=9) as bag:
        connection = bag.add_connection("/eye", message.__msgtype__, typestore=store)
        bag.write(connection, 10, store.serialize_cdr(message, message.__msgtype__))
    (actual,) = log_images(tmp_path / "bag")
    expected = PIXELS[..., [0, 0, 0]] if encoding == "mono8" else PIXELS[..., :3]
    np.testing.assert_array_equal(actual.image, expected)
    assert (actual.frame, actual.stamp) == ("eye", 3_000_000_007)


@pytest.mark.parametrize("time", [1.009, 2.01, 4.012])
def test_stamps_are_the_nearest_nanosecond(tmp_path, time):
    """As floats times 1e9 these are just below it; a nanosecond less would be another time."""
    pytest.importorskip("rosbags.rosbag2", reason="pip install 'fidsplat[logs]'")
    from fidsplat.logs import RobotLog, log_images, log_poses

    with RobotLog(tmp_path / "a.mcap") as log:
        log.image(time, "eye", np.zeros((2, 2, 3)))
        log.transform(time, "eye", np.eye(4))
    (actual,) = log_images(tmp_path / "a.mcap")
    milliseconds = round(time * 1000)
    assert actual.stamp == milliseconds * 10**6
    assert list(log_poses(tmp_path / "a.mcap")) == [("eye", milliseconds * 10**6)]


def test_quaternions_of_sdf_have_x_first_and_joints_are_frames(tmp_path):
    w, x, y, z = TURN
    (tmp_path / "a.sdf").write_text(
        f"""<sdf version="1.9"><model name="m">
      <link name="base"><pose rotation_format="quat_xyzw">1 2 3 {x} {y} {z} {w}</pose></link>
      <link name="arm"><pose relative_to="base">0.5 0 0 0 0 0.3</pose></link>
      <joint name="elbow" type="revolute"><parent>base</parent><child>arm</child>
        <pose>0 0.25 0 0 0.7 0</pose></joint>
      <link name="hand"><pose relative_to="elbow">0 0 1 0 0 0</pose></link>
      <link name="finger"><pose relative_to="inner">0 1 0 0 0 0</pose></link>
      <model name="inner"><link name="tip"/></model></model></sdf>""".replace('"inner::tip"', '"inner"')
    )
    bodies = read_description(tmp_path / "a.sdf").bodies
    np.testing.assert_allclose(bodies["m::base"], [1, 2, 3, *TURN], atol=1e-12)
    base = rigid_matrix((1, 2, 3), TURN)
    arm = base @ rigid_matrix((0.5, 0, 0), (math.cos(0.15), 0, 0, math.sin(0.15)))
    elbow = arm @ rigid_matrix((0, 0.25, 0), (math.cos(0.35), 0, math.sin(0.35), 0))  # in its child
    np.testing.assert_allclose(bodies["m::hand"][:3], (elbow @ [0, 0, 1, 1])[:3], atol=1e-12)
    np.testing.assert_allclose(bodies["m::finger"][:3], [0, 1, 0], atol=1e-12)


def test_links_of_a_robot_are_where_mujoco_has_them(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")
    inertia = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
    names = ("base", "arm", "wrist", "side")
    joints = [
        ("base", "arm", "revolute", "0.1 0.2 1", "0.3 -0.4 0.5"),
        ("arm", "wrist", "prismatic", "2 0 0.3", "1.1 0.2 -0.7"),
        ("base", "side", "revolute", "0 -1 0", "0 0.6 0"),
    ]
    text = '<robot name="r"><mujoco><compiler fusestatic="false"/></mujoco>'
    text += "".join(f'<link name="{name}">{inertia}</link>' for name in names)
    for k, (parent, child, kind, xyz, rpy) in enumerate(joints):
        text += (
            f'<joint name="j{k}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="0 1 0"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
    (tmp_path / "a.urdf").write_text(text + "</robot>")
    ours = read_description(tmp_path / "a.urdf").bodies
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "a.urdf"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for name in names[1:]:
        number = model.body(name).id
        np.testing.assert_allclose(ours[name][:3], data.xpos[number], atol=1e-9)
        turned = quaternion_multiply(ours[name][3:], data.xquat[number] * [1, -1, -1, -1])
        assert abs(turned[0]) == pytest.approx(1, abs=1e-9)


def test_the_middle_of_an_image_is_the_principal_point_that_is_left_out(tmp_path):
    for name in ("a.png", "b.png"):
        write_png(tmp_path / name, np.zeros((14, 21)))
    matrix = rigid_matrix(MOVE, TURN)
    frame = {"file_path": "a.png", "transform_matrix": matrix.tolist(), "fl_x": 30.0, "fl_y": 40.0}
    other = frame | {"file_path": "b.png", "cx": 9.0, "cy": 8.5}
    other["transform_matrix"] = rigid_matrix((0, 0, 0), TURN).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": [frame, other]}))
    views = load_dataset(tmp_path, hold_out=0, random_points=5).views
    assert [(v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy) for v in views] == [
        (30, 40, 10.5, 7),
        (30, 40, 9, 8.5),
    ]
    # 2 m before the camera, which looks along its -z
    ahead = (matrix @ [0, 0, -2, 1])[:3]
    np.testing.assert_allclose(views[0].camera.project([ahead]), [[10.5, 7]], atol=1e-9)


@pytest.mark.parametrize("size", [(21, 14), (14, 21)])
def test_the_angle_of_a_camera_is_that_of_the_width(tmp_path, size):
    """In images that are not square, as Blender and nerfstudio write it."""
    width, height = size
    frames = []
    for k in range(2):
        write_png(tmp_path / f"{k}.png", np.full((height, width), 50 * k))
        matrix = rigid_matrix((k, 0.2, 0.5), TURN).tolist()
        frames.append({"file_path": f"{k}.png", "transform_matrix": matrix})
    actual = {"camera_angle_x": 0.8, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(actual))
    for view in load_dataset(tmp_path, hold_out=0, random_points=5).views:
        focal = width / 2 / np.tan(0.4)
        np.testing.assert_allclose([view.camera.fx, view.camera.fy], focal)
        assert (view.camera.width, view.camera.height) == size
