"""Cameras of all worlds of mujoco_warp: a tag on a box at another place in each world, rendered in one batch.

pip install 'fidsplat[tiled]'
python examples/tiled_cameras.py --worlds 4        a minute on a CPU, which compiles MuJoCo's kernels once
python examples/tiled_cameras.py --worlds 1024 --device warp:cuda
"""

import argparse

import mujoco
import mujoco_warp as mjw
import numpy as np

import fidsplat as fs
from fidsplat.scenes import PlacedMarker
from fidsplat.sim.mujoco import MujocoRig
from fidsplat.vision import read_back

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--worlds", type=int, default=4, help="number of worlds")
parser.add_argument("--device", help="of fs.Renderer")
given = parser.parse_args()

model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
  <body name="box" pos="1.5 0 0.5"><joint type="slide" axis="0 1 0"/><geom type="box" size=".1 .1 .1"/></body>
  <camera name="eye" pos="0 0 .5" xyaxes="0 -1 0 0 0 1" resolution="320 240" fovy="45" output="rgb depth"/>
</worldbody></mujoco>""")
on_box = [[0, 0, 1, -0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]  # on the face towards the camera
scene = fs.Scene(markers=[PlacedMarker(fs.marker("apriltag:36h11:5", size=0.16), on_box)])
rig = MujocoRig(model, scene, {1: "box"}, renderer=fs.Renderer(given.device))

data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
device_model, worlds = mjw.put_model(model), mjw.put_data(model, data, nworld=given.worlds)
worlds.qpos.assign(np.linspace(-0.2, 0.2, given.worlds, dtype=np.float32)[:, None])
mjw.kinematics(device_model, worlds)
mjw.camlight(device_model, worlds)

images = rig.render(worlds, meshes=True)  # the box of MuJoCo and the tag occlude each other
print("rgb", images.of("eye")["rgb"].shape)
for world in range(min(given.worlds, 4)):
    for one in read_back(images.of("eye").frame(world), scene).readings:
        print(f"world {world}: {one.detection.name}, {1e3 * one.position_error:.2f} mm off")
