"""EasyGaussianSplatting, its renderer in NumPy (its folder on PYTHONPATH): 3D Gaussians by EWA, truncated at
3 standard deviations, one splat after the other."""

from pathlib import Path

import numpy as np
from gsplat.gausplat import compute_cov_2d, compute_cov_3d, inverse_cov2d, project, splat


class Adapter:
    settings = {"default": {"ellipsoids": {"ellipsoid": "ewa", "order": "centre"}}}

    def __init__(self):
        pinned = Path(__file__).with_name("requirements.txt").read_text("utf-8").strip().rpartition("@")[2]
        self.facts = {"renderer": "EasyGaussianSplatting", "version": pinned, "kind": "cpu"}
        self.facts |= {"device": "1 thread", "driver": f"NumPy {np.__version__}"}

    def load(self, scene):
        self.scene = scene
        self.covariances = compute_cov_3d(scene["scales"], scene["quats"])

    def render(self, setting, views):
        (fx, _, cx), (_, fy, cy), _ = self.scene["matrix"]
        (width, height), images = map(int, self.scene["size"]), []
        for pose in self.scene["poses"][views]:
            rotation, translation = pose[:3, :3], pose[:3, 3]
            # the centre of its first pixel is (0, 0)
            at, points = project(self.scene["means"], rotation, translation, fx, fy, cx - 0.5, cy - 0.5)
            flat = compute_cov_2d(points, fx, fy, width, height, self.covariances, rotation)
            inverse, areas = inverse_cov2d(flat)
            splats = at, inverse, self.scene["opacities"], points[:, 2], self.scene["colors"], areas
            images.append(splat(height, width, *splats))
        return images

    def read(self, images):
        return images
