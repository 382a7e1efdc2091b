"""A LiDAR on a robot in a greenhouse: scans along an aisle, as one map of points.

    python examples/lidar.py -o aisle.pcd              seconds on two cores; open it in CloudCompare or Open3D
    python examples/lidar.py --lidar os1-64 --scans 20

The sensor moves while it scans, so its beams have different poses; `cloud("world")` uses them.
"""

import argparse

import numpy as np

import fidsplat as fs
from fidsplat.formats.points import save_points
from fidsplat.worlds.greenhouse import AISLE, Greenhouse

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("-o", "--out", default="aisle.pcd", help="FILE.pcd, FILE.ply or FILE.npy")
parser.add_argument("--lidar", default="vlp-16", help="vlp-16, os1-64 or livox-mid-40")
parser.add_argument("--scans", type=int, default=4, help="number of scans, a metre from one to the next")
given = parser.parse_args()

house = Greenhouse(rows=2, plants=4)
renderer = fs.Renderer()
scene = renderer.upload(house.scene)
lidar = fs.Lidar.preset(given.lidar)
SPEED = 1.0  # metres per second along the aisle


def lidar_from_world(time: float) -> np.ndarray:
    """Pose of the sensor at a time: x forward along the aisle, 0.7 m above the floor."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array([SPEED * time - 1.0, AISLE / 2, 0.7])
    return pose


motion, points = fs.Motion(camera=lidar_from_world), []
for number in range(given.scans):
    scan = fs.scan(scene, lidar, motion=motion, renderer=renderer, start=number / SPEED, index=number)
    points.append(scan.cloud("world"))  # x, y, z, intensity, ring, time, echo
    median = np.median(scan.range[scan.range > 0])
    print(f"scan {number}: {len(points[-1]):,} points, median range {median:.2f} m")
save_points(np.concatenate(points), given.out)
print(f"{given.out}: {sum(map(len, points)):,} points")
