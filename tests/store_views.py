"""Stores of small splats around the origin in small chunks, and cameras among them."""

import math

import numpy as np
import pytest

import fidsplat as fs
from fidsplat.scenes.random_clouds import random_splats
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.store import build_plan
from fidsplat.store.sources import source_of

COUNT = 3000
SIZE = 40, 30


def splats(seed, thick=False, sh_degree=None):
    """Small splats on all sides of the origin."""
    cloud = random_splats(COUNT, seed, depth=(-4, 4), scale=(3e-3, 0.1), across=4.0, sh_degree=sh_degree)
    if not thick:
        return cloud
    third = (
        cloud.scales.max(axis=1) * np.array([0.0, 0.5, 1.2])[np.arange(COUNT) % 3]
    )  # also the longest axis
    scales = np.column_stack([cloud.scales, third])
    return fs.SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, colors=cloud.colors)


def build_small_store(folder, cloud, name):
    source = source_of(cloud, folder / name, "test")
    return fs.Store(fs.build_store([source], folder / f"{name}.fss", chunk=64))


def build_small_stores(folder):
    """Disks, 3D Gaussians, disks with SH, and a wall of many disks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_plan, "_MIN_MEMORY", 0)
        clouds = {"disks": splats(1), "thick": splats(2, thick=True), "sh": splats(3, sh_degree=2)}
        clouds["wall"] = random_splats(3 * COUNT, 5, depth=(3, 3.2), scale=(7e-3, 0.02), across=3.0)
        return {name: build_small_store(folder, cloud, name) for name, cloud in clouds.items()}


def look(fov=60.0, turn=(1.0, 0.0, 0.0, 0.0), at=(0.0, 0.0, 0.0), aspect=1.0, **given):
    """A camera of SIZE pixels. aspect: fy / fx."""
    camera = fs.Camera.look_at(*SIZE, math.radians(fov), position=(0, 0, 0), target=(0, 0, 1))
    pose = np.linalg.inv(rigid_matrix(at, turn))
    focal = given.pop("focal", camera.fx)
    center = given.pop("center", (SIZE[0] / 2, SIZE[1] / 2))
    return fs.Camera.pinhole(*SIZE, focal, aspect * focal, *center, pose, **given)


TURNED = (0.8, 0.1, -0.5, 0.2)
