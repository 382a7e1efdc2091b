"""Cameras of all worlds of mujoco_warp and Newton, against rays of MuJoCo in C; Isaac Lab's interface."""

import inspect
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.sim import Rig, RigCamera
from fidsplat.sim.poses import OPTICAL, inverse, matrix_of

mujoco = pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")

WIDTH, HEIGHT, FOCAL = 32, 24, 98.0
MODEL = f"""<mujoco><worldbody>
  <body name="box" pos="1.5 0 0.5"><geom type="box" size=".1 .1 .1" rgba="0 1 0 1"/></body>
  <body name="ball" pos="1.2 .06 .5"><joint type="slide" axis="0 0 1"/>
    <geom type="sphere" size=".04" rgba="1 1 0 1" mass="1"/></body>
  <camera name="eye" pos="0 0 .5" xyaxes="0 -1 0 0 0 1" resolution="{WIDTH} {HEIGHT}"
    focalpixel="{FOCAL} {FOCAL}" sensorsize="1 0.75"/>
</worldbody></mujoco>"""
HEIGHTS = 0.0, 0.03
"""metres of the ball in each world"""
OFFSET = 2e-3
ON_FACE = [[0, 0, 1, -0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
OUTPUTS = "rgb", "depth", "label"
PINHOLE = fs.Camera.pinhole(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, matrix_of(inverse(OPTICAL)))
CAMERAS = {"eye": RigCamera(PINHOLE, "eye")}


@pytest.fixture(scope="module")
def states():
    """The model, and MuJoCo's state of each world."""
    model, results = mujoco.MjModel.from_xml_string(MODEL), []
    for height in HEIGHTS:
        data = mujoco.MjData(model)
        data.qpos[0] = height
        mujoco.mj_forward(model, data)
        results.append(data)
    return model, results


@pytest.fixture(scope="module")
def scene():
    tag = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.1), ON_FACE)
    return fs.Scene(markers=[tag], background=(0.2, 0.3, 0.6))


def surfaces(model, data):
    """Geom and depth of each pixel by MuJoCo's rays: id -1 without a geom."""
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = np.stack([np.full_like(x, FOCAL), -x, -y], -1).reshape(-1, 3) / FOCAL
    geoms, depths, geom = np.full(len(rays), -1), np.zeros(len(rays)), np.zeros(1, np.int32)
    for k, ray in enumerate(rays):
        depths[k] = mujoco.mj_ray(model, data, np.array([0, 0, 0.5]), ray, None, 1, -1, geom)
        geoms[k] = geom[0]
    return geoms.reshape(HEIGHT, WIDTH), depths.reshape(HEIGHT, WIDTH)


def check(images, states, geom_of):
    """Geoms are where MuJoCo's rays find them, with their depths, except where the tag is on the box."""
    for world, data in enumerate(states[1]):
        geoms, depths = surfaces(states[0], data)
        frame = images.of("eye").frame(world)
        label, depth = frame["label"], frame["depth"]
        mesh, tag = label < -1, label == 1
        assert mesh.sum() > 60
        assert tag.sum() > 20
        np.testing.assert_array_equal(geom_of(label[mesh]), geoms[mesh])
        near_tag = np.lib.stride_tricks.sliding_window_view(np.pad(tag, 1), (3, 3)).any((2, 3))
        pure = mesh & ~near_tag  # whose edges cover parts of pixels
        assert pure.sum() > 50
        np.testing.assert_allclose(depth[pure], depths[pure] + OFFSET, rtol=1e-4)
        assert (geoms[tag] == 0).all()
        assert abs(depth[tag].mean() - 1.4) < 1e-3
        np.testing.assert_array_equal(label == -1, geoms == -1)


def test_mujoco_warps_geoms_are_composited_in_all_worlds(states, scene):
    warp = pytest.importorskip("mujoco_warp", reason="pip install 'fidsplat[tiled]'")
    from fidsplat.sim.mujoco import MESH_LABEL, MujocoRig

    model, single = states
    there, worlds = warp.put_model(model), warp.put_data(model, single[0], nworld=len(single))
    worlds.qpos.assign(np.stack([data.qpos for data in single]).astype(np.float32))
    warp.kinematics(there, worlds)
    warp.camlight(there, worlds)
    rig = MujocoRig(model, scene, {1: "box"}, renderer=fs.Renderer("reference"), outputs=OUTPUTS)
    check(rig.render(worlds, meshes=True), states, lambda label: MESH_LABEL - label)
    assert set(np.unique(rig.render(worlds, meshes=3)["label"])) == {-1, 1}
    square = mujoco.MjModel.from_xml_string(MODEL.replace('sensorsize="1 0.75"', 'sensorsize="1 1"'))
    with pytest.raises(fs.InputError, match="aspect ratio of its resolution 32 x 24, got 1 x 1 for 'eye'"):
        MujocoRig(square, scene, {1: "box"}, renderer=rig.renderer).render(worlds, meshes=True)


def test_the_example_reads_the_tag_of_each_world(monkeypatch, capsys):
    pytest.importorskip("mujoco_warp", reason="pip install 'fidsplat[tiled]'")
    example = Path(__file__).resolve().parents[2] / "examples" / "tiled_cameras.py"
    monkeypatch.setattr(sys, "argv", [str(example), "--worlds", "2"])
    runpy.run_path(str(example), run_name="__main__")
    error_output = capsys.readouterr().out
    assert "rgb (2, 240, 320, 3)" in error_output
    errors = re.findall(r"world (\d): apriltag:36h11:5, ([\d.]+) mm off", error_output)
    assert [world for world, _ in errors] == ["0", "1"]
    assert max(float(error) for _, error in errors) < 5


def test_newtons_shapes_are_composited_in_all_worlds(states, scene):
    newton = pytest.importorskip("newton", reason="pip install 'fidsplat[tiled]'")
    import warp as wp

    from fidsplat.sim.newton import NewtonRig

    world, builder = newton.ModelBuilder(), newton.ModelBuilder()
    for name, place in (("box", (1.5, 0, 0.5)), ("eye", (0, 0, 0.5)), ("ball", (1.2, 0.06, 0.5))):
        world.add_body(xform=wp.transform(place, wp.quat_identity()), label=name)
    world.add_shape_box(0, hx=0.1, hy=0.1, hz=0.1, color=(0, 1, 0))
    world.add_shape_sphere(2, radius=0.04, color=(1, 1, 0))
    builder.replicate(world, len(HEIGHTS))
    model = builder.finalize(device="cpu")
    state = model.state()
    poses = state.body_q.numpy()
    poses[2::3, 2] += HEIGHTS
    state.body_q.assign(poses)
    arguments = {"renderer": fs.Renderer("reference"), "outputs": OUTPUTS}
    rig = NewtonRig(model, scene, {1: "box"}, CAMERAS, **arguments)
    check(rig.render(state, meshes=True), states, lambda label: (-2 - label) % 2)
    with pytest.raises(fs.InputError, match=r"unknown body 'bx' \(did you mean 'box'\?\)"):
        NewtonRig(model, scene, {1: "bx"}, CAMERAS, **arguments)
    builder.add_world(newton.ModelBuilder())
    with pytest.raises(fs.InputError, match="all worlds of a model must have the same number of bodies"):
        NewtonRig(builder.finalize(device="cpu"), scene, {1: "box"}, CAMERAS, **arguments)


# `supported_output_types` of Isaac Lab's renderers, `Camera` and `CameraData` of isaac-sim/IsaacLab, 00b36b75
ISAAC_LAB = {
    "rgb": (3, "uint8"),
    "rgba": (4, "uint8"),
    "depth": (1, "float32"),
    "distance_to_image_plane": (1, "float32"),
    "distance_to_camera": (1, "float32"),
    "normals": (3, "float32"),
    "semantic_segmentation": (1, "int32"),  # without colorize_semantic_segmentation
}
ISAAC_LAB_METHODS = {
    "update": ["dt", "force_recompute"],
    "reset": ["env_ids", "env_mask"],
    "set_world_poses": ["positions", "orientations", "env_ids", "convention"],
    "set_world_poses_from_view": ["eyes", "targets", "env_ids"],
}
ISAAC_LAB_DATA = {
    "pos_w": 3,
    "quat_w_world": 4,
    "quat_w_ros": 4,
    "quat_w_opengl": 4,
    "intrinsic_matrices": (3, 3),
}


def test_the_interface_is_that_of_isaac_labs_source(scene):
    """Names, shapes, types and the device of every output."""
    torch = pytest.importorskip("torch", reason="pip install torch")
    from fidsplat.sim.isaaclab import TiledCamera

    for device in ("reference", *(info.name for info in fs.devices() if info.name.startswith("warp:cuda"))):
        rig = Rig(scene, cameras=CAMERAS | {"eye": RigCamera(PINHOLE)}, renderer=fs.Renderer(device))
        tiled = TiledCamera(rig, 2, list(ISAAC_LAB))
        data = tiled.data
        assert (tiled.num_instances, tiled.image_shape, data.image_shape) == (
            2,
            (HEIGHT, WIDTH),
            (HEIGHT, WIDTH),
        )
        assert data.info == dict.fromkeys(data.output)
        assert list(data.output) == list(ISAAC_LAB)
        place = torch.device("cuda" if "cuda" in device else "cpu").type
        for name, (channels, kind) in ISAAC_LAB.items():
            image = data.output[name]
            assert image.shape == (2, HEIGHT, WIDTH, channels)
            assert (image.dtype, image.device.type) == (getattr(torch, kind), place)
        for name, shape in ISAAC_LAB_DATA.items():
            value = getattr(data, name)
            assert value.shape == (2, *np.atleast_1d(shape))
            assert (value.dtype, value.device.type) == (torch.float32, place)
        assert data.output["rgba"][..., :3].equal(data.output["rgb"])
        visible = data.output["semantic_segmentation"][..., 0] == 1
        assert (data.output["rgba"][..., 3][visible] > 127).all()
        assert data.output["rgba"][0, 0, 0, 3] == 0


@pytest.mark.parametrize("name", ISAAC_LAB_METHODS)
def test_methods_have_the_parameters_of_isaac_labs_source(name):
    from fidsplat.sim.isaaclab import TiledCamera

    parameters = list(inspect.signature(getattr(TiledCamera, name)).parameters)
    assert parameters[1:] == ISAAC_LAB_METHODS[name]


def test_isaac_labs_cameras(scene):
    """Environments apart from each other have equal images; shapes, types and conventions of Isaac Lab."""
    torch = pytest.importorskip("torch", reason="pip install torch")
    from fidsplat.sim.isaaclab import TiledCamera

    rig = Rig(scene, {1: "box"}, CAMERAS, renderer=fs.Renderer("reference"))
    origins = torch.tensor([[0.0, 0, 0], [5, 0, 0]])
    upright = torch.tensor([[0.0, 0, 0, 1]] * 2)  # x y z w
    places = {"box": [1.5, 0, 0.5], "eye": [0, 0, 0.5]}
    poses = {name: torch.cat([origins + torch.tensor(p), upright], 1) for name, p in places.items()}
    kinds = "rgb", "depth", "distance_to_camera", "normals", "semantic_segmentation"
    tiled = TiledCamera(rig, 2, kinds, bodies=lambda: poses, origins=origins, update_period=0.1)
    data = tiled.data
    middle = HEIGHT // 2, WIDTH // 2
    assert data.output["depth"][:, *middle, 0].tolist() == pytest.approx([1.4, 1.4], abs=1e-5)
    assert torch.isinf(data.output["depth"][0, 0, 0, 0])
    assert data.output["normals"][0, *middle].tolist() == pytest.approx([-1, 0, 0], abs=1e-6)
    assert data.output["semantic_segmentation"][:, *middle, 0].tolist() == [1, 1]
    np.testing.assert_allclose(data.pos_w, origins + torch.tensor([0, 0, 0.5]))
    np.testing.assert_allclose(data.quat_w_world, upright, atol=1e-12)
    np.testing.assert_allclose(data.quat_w_ros, [[-0.5, 0.5, -0.5, 0.5]] * 2, atol=1e-12)
    shared = data.output["rgb"]
    before = shared.clone()
    tiled.update(0.05)
    assert tiled.data.output["rgb"].equal(before)
    assert tiled.frame.tolist() == [1, 1]
    tiled.set_world_poses(torch.tensor([[0.3, 0, 0.5]]), upright[:1], [0], convention="world")
    data = tiled.data
    assert data.output["depth"][:, *middle, 0].tolist() == pytest.approx([1.1, 1.4], abs=1e-5)
    assert data.output["rgb"][1].equal(before[1])
    assert not data.output["rgb"][0].equal(before[0])
    assert shared.equal(before)  # tensors keep their images
    assert tiled.frame.tolist() == [2, 1]
    tiled.set_world_poses_from_view([[0.2, 0, 0.5]], [[1.0, 0, 0.5]], torch.tensor([0]))
    assert tiled.data.output["depth"][0, *middle, 0].item() == pytest.approx(1.2, abs=1e-5)
    tiled.reset(env_mask=torch.tensor([False, True]))
    assert tiled.frame.tolist() == [3, 0]
    with pytest.raises(fs.InputError, match=r"origins must have the shape \(2, 3\), got \(1, 3\)"):
        TiledCamera(rig, 2, bodies=lambda: poses, origins=origins[:1])
    with pytest.raises(fs.InputError, match="unknown data type None"):
        TiledCamera(rig, 2, (), bodies=lambda: poses)
    with pytest.raises(fs.InputError, match="unknown data type 'rbg'"):
        TiledCamera(rig, 2, ["rbg"], bodies=lambda: poses)
    with pytest.raises(fs.InputError, match="bodies must return the poses of box, eye"):
        TiledCamera(rig, 2)
