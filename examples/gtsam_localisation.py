"""Poses of `fs.localise` as factors of GTSAM: `pip install gtsam && python examples/gtsam_localisation.py`.

A camera moves through a room. Each image gives a prior factor with the covariance of its pose; odometry with
5 mm of noise connects the poses.
"""

import gtsam
import numpy as np

import fidsplat as fs
from fidsplat.worlds.greenhouse import Greenhouse

scene = Greenhouse(rows=2, plants=3).scene
camera = scene.camera.resampled(320, 180)
renderer = fs.Renderer()
resident = renderer.upload(scene)
random = np.random.default_rng(0)

graph, values, true = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
odometry = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([1e-3, 5e-3], 3))  # radians, metres
for number in range(4):
    position = camera.position + np.array([0.2 * number, 0.0, 0.0])
    true.append(camera.with_pose(position=position))
    image = renderer.render(resident, true[-1])["rgb"] + random.normal(0, 0.02, (180, 320, 3))
    found = fs.localise(image, scene, true[-1], renderer=renderer, resident=resident)
    # a motion after world_to_camera is the inverse of GTSAM's motion after camera_to_world; both numbers are
    # rotation, then translation in camera axes, so the covariance is the same
    pose = gtsam.Pose3(found.camera.camera_to_world)
    graph.add(gtsam.PriorFactorPose3(number, pose, gtsam.noiseModel.Gaussian.Covariance(found.covariance)))
    values.insert(number, pose)
    if number:
        step = true[-2].world_to_camera @ true[-1].camera_to_world
        step[:3, 3] += random.normal(0, 5e-3, 3)
        graph.add(gtsam.BetweenFactorPose3(number - 1, number, gtsam.Pose3(step), odometry))
result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
for number, at in enumerate(true):
    error = 1e3 * np.linalg.norm(result.atPose3(number).translation() - at.position)
    print(f"pose {number}: {error:.3f} mm off")
