"""MuJoCo's geoms composited with splats in one call, compared with MuJoCo's own images.

MuJoCo selects its OpenGL platform when it is imported, so each test runs a process of its own.
"""

import os
import subprocess
import sys

import pytest

pytest.importorskip("mujoco", reason="pip install 'fidsplat[sim]'")

SETUP = """
import mujoco, numpy as np, fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.sim.mujoco import MESH_LABEL, MESH_OFFSET, MujocoRig
model = mujoco.MjModel.from_xml_string('''<mujoco>
  <visual><global offwidth="100" offheight="60"/></visual>
  <asset><texture type="skybox" builtin="gradient" rgb1="1 0 0" rgb2="1 0 0" width="64" height="64"/></asset>
  <worldbody><light pos="0 0 3"/>
    <body name="box" pos="1.5 0 0.5"><geom type="box" size=".1 .1 .1" rgba="0 1 0 1"/></body>
    <body pos="1.2 .06 .5"><joint type="slide" axis="0 0 1"/>
      <geom type="sphere" size=".04" rgba="1 1 0 1" group="3" mass="1"/></body>
    <camera name="eye" pos="0 0 .5" xyaxes="0 -1 0 0 0 1" resolution="104 78" fovy="14"/>
    <camera name="flat" xyaxes="0 -1 0 0 0 1" resolution="32 24" fovy="1" projection="orthographic"/>
  </worldbody></mujoco>''')
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
on_face = [[0, 0, 1, -0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
tag = PlacedMarker(fs.marker("apriltag:36h11:5", size=0.12), on_face)
scene = fs.Scene(markers=[tag], background=(0.2, 0.3, 0.6))
OUTPUTS = "rgb", "depth", "label"
rig = MujocoRig(model, scene, {1: "box"}, ["eye"], outputs=OUTPUTS, renderer=fs.Renderer("reference"))


def refusal(call):
    try:
        call()
    except fs.InputError as error:
        return str(error)
"""
MESHES = (
    SETUP
    + """
images = rig.render(data, meshes=range(6)).of("eye").frame(0)
label, depth, rgb = images["label"], images["depth"], images["rgb"]
assert set(np.unique(label)) == {-1, 1, MESH_LABEL, MESH_LABEL - 1}, np.unique(label)
assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (100, 60)  # the model is as before

# MuJoCo's own image: the same pixels are geoms, with its colours and depths; its red sky is nowhere
model.vis.global_.offwidth, model.vis.global_.offheight, model.vis.quality.offsamples = 104, 78, 0
own, option = mujoco.Renderer(model, 78, 104), mujoco.MjvOption()
option.geomgroup[:] = 1
own.update_scene(data, camera="eye", scene_option=option)
colors = own.render() / 255
own.enable_depth_rendering()
metres = own.render()
own.enable_segmentation_rendering()
geoms = own.render()[..., 0]
mesh = label < -1
np.testing.assert_array_equal(label[mesh], MESH_LABEL - geoms[mesh])
near_tag = np.lib.stride_tricks.sliding_window_view(np.pad(label == 1, 1), (3, 3)).any((2, 3))
mesh &= ~near_tag  # whose edges cover parts of pixels
assert mesh.sum() > 1000
np.testing.assert_allclose(rgb[mesh], colors[mesh], atol=1e-6)
np.testing.assert_allclose(depth[mesh], metres[mesh] + MESH_OFFSET, rtol=1e-6)
assert (geoms[label == -1] == -1).all()
np.testing.assert_allclose(rgb[label == -1], np.broadcast_to((0.2, 0.3, 0.6), (np.sum(label == -1), 3)))
# the tag is on the face of the box, in front of it and behind the ball
assert (geoms[label == 1] == 0).all()
assert np.ptp(depth[label == 1]) < 1e-5 and abs(depth[label == 1].mean() - 1.4) < 1e-5
ball = geoms == 1
assert ball.sum() > 100 and (label[ball] == MESH_LABEL - 1).all()

# geom groups: MuJoCo shows 0, 1 and 2 by default; environments are rendered one by one
other = mujoco.MjData(model)
other.qpos[0] = 0.05
mujoco.mj_forward(model, other)
labels = rig.render([data, other], meshes=True)["label"]
assert set(np.unique(labels)) == {-1, 1, MESH_LABEL}
labels = rig.render([data, other], meshes=3)["label"][:, 0]
assert set(np.unique(labels)) == {-1, 1, MESH_LABEL - 1}
rows = [np.flatnonzero((one == MESH_LABEL - 1).any(1)).mean() for one in labels]
assert rows[1] < rows[0] - 5  # the ball has moved up

both = MujocoRig(model, scene, {1: "box"}, renderer=fs.Renderer("reference"))
assert "'flat' with the lens orthographic" in refusal(lambda: both.render(data, meshes=True))
assert "got both; leave one out" in refusal(lambda: rig.render(data, meshes=True, external_depths={}))
assert "a geom group of meshes must be" in refusal(lambda: rig.render(data, meshes=[6]))
assert "data with meshes must be a mujoco.MjData" in refusal(lambda: rig._meshes([None], True))
print("done")
"""
)
NO_OPENGL = SETUP + "print(refusal(lambda: rig.render(data, meshes=True)))\n"
EGL = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"


def run(program, platform):
    environment = os.environ | {"MUJOCO_GL": platform}
    command = [sys.executable, "-c", program]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)


def test_geoms_and_splats_occlude_each_other():
    done = run(MESHES, "egl")
    if "done" not in done.stdout and run(EGL, "egl").returncode:
        pytest.skip("no EGL here")
    assert done.stdout == "done\n", done.stderr


def test_meshes_need_opengl():
    done = run(NO_OPENGL, "off")
    assert "set MUJOCO_GL=egl or MUJOCO_GL=osmesa" in done.stdout, done.stderr
