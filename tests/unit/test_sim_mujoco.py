"""MuJoCo's cameras and bodies, and Gymnasium's observations."""

import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.cameras import Orthographic
from fidsplat.scenes import PlacedMarker
from fidsplat.vision import read_back

mujoco = pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")
gymnasium = pytest.importorskip("gymnasium", reason="pip install 'fidsplat[sim]'")

MODEL = """
<mujoco>
  <visual><global offwidth="200" offheight="150"/></visual>
  <worldbody>
    <body name="box" pos="2 0.1 0.5">
      <freejoint/><geom type="box" size=".2 .2 .2" mass="1"/>
    </body>
    <body name="robot" pos="0 0 0.4">
      <joint type="slide" axis="1 0 0"/><joint type="hinge" axis="0 0 1"/>
      <geom type="sphere" size=".1" mass="1"/>
      <camera name="front" pos=".1 0 .05" xyaxes="0 -1 0 0.05 0 1" resolution="320 240" fovy="50"
              output="rgb depth"/>
      <camera name="lens" pos=".1 0 .05" xyaxes="0 -1 0 0.05 0 1" resolution="320 240" focalpixel="260 250"
              principalpixel="12 -7" sensorsize="0.0036 0.0024"/>
      <camera name="plain" pos=".1 0 .05" xyaxes="0 -1 0 0 0 1" fovy="70"/>
      <camera pos="0 0 0"/>
    </body>
    <camera name="above" pos="1 0 3" xyaxes="0 -1 0 1 0 0" projection="orthographic" fovy="1.5"
            resolution="100 50"/>
  </worldbody>
</mujoco>
"""
FACE = np.array([[0, 0, 1, -0.2], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
"""box from marker: on the side towards -x and upright, its x along -y and its y along -z"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture(scope="module")
def scene():
    return fs.Scene(
        markers=[PlacedMarker(fs.marker("apriltag:36h11:5", size=0.3), FACE)], background=(0.5,) * 3
    )


@pytest.fixture(scope="module")
def rig(model, scene):
    from fidsplat.sim.mujoco import MujocoRig

    return MujocoRig(model, scene, {1: "box"}, renderer=fs.Renderer("opencl:pocl"))


def moved(model, seed):
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:3] += rng.uniform(-0.1, 0.1, 3)
    rotation = np.array([1, *rng.uniform(-0.2, 0.2, 3)])
    data.qpos[3:7] = rotation / np.linalg.norm(rotation)
    data.qpos[7:] = rng.uniform(-0.1, 0.1, 2)
    mujoco.mj_forward(model, data)
    return data


def test_a_tag_is_read_where_mujoco_says_it_is(model, rig):
    """Axes of bodies and cameras, tested by images: the expected positions are computed from MuJoCo's own
    matrices."""
    states = [moved(model, seed) for seed in (0, 1)]
    images = rig.render(states)
    assert tuple(rig.cameras) == ("above", "front", "lens", "plain")
    for camera in ("front", "lens", "plain"):
        for i, data in enumerate(states):
            box = np.eye(4)
            box[:3, :3], box[:3, 3] = data.body("box").xmat.reshape(3, 3), data.body("box").xpos
            eye = np.eye(4)
            eye[:3, :3] = data.camera(camera).xmat.reshape(3, 3) @ np.diag([1.0, -1.0, -1.0])
            eye[:3, 3] = data.camera(camera).xpos
            expected = np.linalg.inv(eye) @ box @ FACE
            (reading,) = read_back(images.of(camera).frame(i), rig.scene).readings
            np.testing.assert_allclose(reading.truth, expected, atol=1e-9)
            assert np.linalg.norm(reading.pose[:3, 3] - expected[:3, 3]) < 0.01, (camera, i)


@pytest.mark.parametrize("name", ["front", "lens", "plain", "above"])
def test_intrinsics_are_those_that_mujoco_renders_with(model, name):
    """Against the frustum of MuJoCo's own renderer, which needs no window."""
    from fidsplat.sim.mujoco import camera_of

    data = moved(model, 3)
    fixed = mujoco.MjvCamera()
    fixed.type, fixed.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(name).id
    rendered = mujoco.MjvScene(model, maxgeom=10)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, fixed, mujoco.mjtCatBit.mjCAT_ALL, rendered)
    gl, ours = rendered.camera[0], camera_of(model, name).camera
    half = gl.frustum_width or (gl.frustum_top - gl.frustum_bottom) / 2 * ours.width / ours.height
    left, right = gl.frustum_center - half, gl.frustum_center + half
    reach = 1.0 if gl.orthographic else gl.frustum_near
    scale = 1.0 if gl.orthographic else 1 / reach
    edges = [
        ((0 - ours.cx) / ours.fx, left * scale),
        ((ours.width - ours.cx) / ours.fx, right * scale),
        ((0 - ours.cy) / ours.fy, -gl.frustum_top * scale),
        ((ours.height - ours.cy) / ours.fy, -gl.frustum_bottom * scale),
    ]
    for mine, theirs in edges:
        assert mine == pytest.approx(theirs, abs=1e-6), (name, edges)
    assert (ours.lens is not None) == bool(gl.orthographic)


def test_what_a_camera_of_the_model_says_of_itself(model):
    from fidsplat.sim.mujoco import camera_of

    front, plain, above = (camera_of(model, name) for name in ("front", "plain", "above"))
    assert front.outputs == ("rgb", "depth")
    assert (front.camera.width, front.camera.height) == (320, 240)
    assert front.camera.fy == pytest.approx(120 / math.tan(math.radians(25)))
    assert (plain.camera.width, plain.camera.height) == (200, 150)
    assert isinstance(above.camera.lens, Orthographic)


def test_outputs_of_the_model_are_what_is_rendered(model, rig):
    images = rig.render(moved(model, 0))
    depth = images.of("front")["depth"]
    assert depth.shape == (1, 240, 320)
    assert 1.2 < np.median(depth[depth > 0]) < 2.2
    assert tuple(images.of("plain")) == ("rgb",)


@pytest.mark.parametrize(
    ("bodies", "cameras", "words"),
    [
        ({1: "bos"}, None, r"unknown body 'bos' \(did you mean 'box'\?\); known: world, box, robot"),
        ({1: "box"}, ["fron"], r"unknown camera 'fron' \(did you mean 'front'\?\); known: above, front"),
        ({2: "box"}, None, "the label of the body 'box' must be"),
        ({1: "box"}, "front", r"cameras must be a list of names, got 'front'; use \['front'\]"),
    ],
)
def test_names_that_the_model_does_not_have(model, scene, bodies, cameras, words):
    from fidsplat.sim.mujoco import MujocoRig

    with pytest.raises(fs.InputError, match=words):
        MujocoRig(model, scene, bodies, cameras, renderer=fs.Renderer("opencl:pocl"))


class OnDevice:
    """An array as mujoco_warp has it."""

    def __init__(self, array):
        self._array = array

    def numpy(self):
        return self._array


class Worlds:
    """Batched data: positions and axes with the worlds first."""

    def __init__(self, states, model):
        shapes = {"xpos": (-1, 3), "xquat": (-1, 4), "cam_xpos": (-1, 3), "cam_xmat": (-1, 3, 3)}
        for name, shape in shapes.items():
            arrays = [np.asarray(getattr(data, name), np.float32).reshape(shape) for data in states]
            setattr(self, name, OnDevice(np.stack(arrays)))


def test_batched_data_has_the_poses_of_its_worlds(model, rig):
    states = [moved(model, seed) for seed in (4, 5, 6)]
    for batched, single in zip(rig.poses(Worlds(states, model)), rig.poses(states), strict=True):
        assert batched.shape == single.shape
        np.testing.assert_allclose(batched, single, atol=1e-6)


def test_mujoco_warps_own_data(model, rig):
    """Worlds that were stepped differently, on the processor."""
    warp = pytest.importorskip("mujoco_warp", reason="pip install mujoco-warp")
    states = [moved(model, seed) for seed in (7, 8)]
    there = warp.put_model(model)
    worlds = warp.put_data(model, states[0], nworld=2)
    worlds.qpos.assign(np.stack([data.qpos for data in states]).astype(np.float32))
    warp.kinematics(there, worlds)
    warp.camlight(there, worlds)
    for batched, single in zip(rig.poses(worlds), rig.poses(states), strict=True):
        np.testing.assert_allclose(batched, single, atol=1e-5)


def test_data_without_poses(rig):
    with pytest.raises(fs.InputError, match=r"must be a mujoco\.MjData"):
        rig.render("data")
    with pytest.raises(fs.InputError, match="got an empty list"):
        rig.render([])


@pytest.mark.parametrize("nbody", [1, 9])
def test_data_of_another_model(rig, nbody):
    bodies = "<body/>" * nbody
    other = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(other)
    mujoco.mj_forward(other, data)
    words = rf"data\.xpos must have \d rows as the rig's model, got {nbody + 1}; give data of that model"
    with pytest.raises(fs.InputError, match=words):
        rig.render(data)


class Pushed(gymnasium.Env):
    """The model, pushed along."""

    def __init__(self, model):
        self.model, self.data = model, mujoco.MjData(model)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        return self.data.qpos[7:].copy(), {}

    def step(self, action):
        self.data.qpos[7] += 0.1 * float(action[0])
        mujoco.mj_forward(self.model, self.data)
        return self.data.qpos[7:].copy(), 0.0, False, False, {}


def test_gymnasium_observes_what_the_cameras_see(model, scene):
    from fidsplat.sim.gymnasium import SplatObservation
    from fidsplat.sim.mujoco import MujocoRig

    rig = MujocoRig(model, scene, {1: "box"}, ["front"], renderer=fs.Renderer("opencl:pocl"))
    env = SplatObservation(Pushed(model), rig)
    first, _ = env.reset(seed=0)
    second, *_ = env.step(np.ones(1, np.float32))
    assert set(first) == {"state", "front_rgb", "front_depth"}
    assert env.observation_space.contains(second)
    assert first["front_rgb"].dtype == np.uint8
    near = [seen["front_depth"][seen["front_depth"] > 0].mean() for seen in (first, second)]
    assert near[0] - near[1] == pytest.approx(0.1, abs=0.01)


def test_the_ten_lines_of_the_pages_render_a_tag_that_is_read():
    root, names = Path(__file__).resolve().parents[2], {}
    readme, page = (
        re.search(r"```python\n(import mujoco.*?)```", (root / name).read_text("utf-8"), re.DOTALL)[1]
        for name in ("README.md", "docs/simulation.md")
    )
    assert readme == page
    exec(readme, names)
    images = names["images"]
    (reading,) = read_back(images.of("eye").frame(0), names["rig"].scene).readings
    assert reading.position_error < 0.003  # 0.2 % of 1.4 m


def test_gymnasium_needs_to_know_where_bodies_are(rig):
    from fidsplat.sim.gymnasium import SplatObservation

    class Blind(gymnasium.Env):
        observation_space = action_space = gymnasium.spaces.Discrete(2)

    with pytest.raises(fs.InputError, match="must have MuJoCo data"):
        SplatObservation(Blind(), rig)


VECTOR = """
import gymnasium, numpy as np, fidsplat as fs
from fidsplat.sim import Rig
from fidsplat.sim.gymnasium import SplatObservation

class Still(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (1,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    def reset(self, seed=None, options=None):
        return np.zeros(1, np.float32), {}

def make():
    splat = fs.SplatCloud([[0, 0, 2.0]], [[1, 0, 0, 0]], [[0.4, 0.2]], [0.9], colors=[[1, 0.5, 0]])
    rig = Rig(splat, cameras={"front": fs.Camera.pinhole(32, 24, 25, 25, 16, 12)})
    return SplatObservation(Still(), rig, lambda env: ({}, {}))

if __name__ == "__main__":
    envs = gymnasium.vector.AsyncVectorEnv([make, make])
    images = envs.reset()[0]["front_rgb"]
    envs.close()
    alone = make().reset()[0]["front_rgb"]      # the first renderer of this process
    assert images.shape == (2, 24, 32, 3) and images.any()
    assert (images == alone).all()
"""


def test_gymnasium_starts_its_workers_by_fork(tmp_path):
    script = tmp_path / "vector.py"
    script.write_text(VECTOR)
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
