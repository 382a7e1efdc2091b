"""Where to hang tags: four tags planned for a camera that moves along an aisle of a greenhouse.

    pip install 'fidsplat[experiments]'
    python examples/plan_tags.py                       half a minute on two cores; look at plan/map.svg

`fidsplat plan-tags` does the same for a scene file and a file of poses.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

import fidsplat as fs
from fidsplat.experiments.plan_tags import PlanSettings, plan_tags, write_plan
from fidsplat.worlds.greenhouse import AISLE, Greenhouse

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("-o", "--out", default="plan", help="folder")
parser.add_argument("--count", type=int, default=4, help="number of tags")
parser.add_argument("--poses", type=int, default=150, help="number of evaluated poses")
given = parser.parse_args()

house = Greenhouse(rows=1, plants=4)
pinhole = fs.Camera.pinhole(320, 240, 260, 260, 160, 120)
scene = replace(house.scene, markers=(), camera=pinhole)  # the tags of the greenhouse are left out
times = np.linspace(0.0, 8.0, 17)
poses = [  # x right, y down, z forward, as of any camera; towards the row, at 0.3 m/s
    pinhole.with_pose(position=(x, -AISLE / 2, 0.5), target=(x + 0.6, 0.0, 0.3), up=(0, 0, 1)).camera_to_world
    for x in 0.3 * times
]
settings = PlanSettings(count=given.count, size=0.1, poses=given.poses)
plan = plan_tags(scene, fs.Trajectory(times, poses), settings, fs.Renderer())
facts = plan.facts()
for tag in facts["tags"]:
    print(tag["spec"], np.round(tag["position"], 2), f"read at {tag['poses']} poses")
print(f"predicted error: {facts['error_without_m']:.3f} m without tags, {facts['error_m']:.4f} m with them")
folder = Path(given.out)
folder.mkdir(parents=True, exist_ok=True)
print(*write_plan(plan, folder, size=0.1))
