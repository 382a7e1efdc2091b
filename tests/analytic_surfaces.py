"""Scenes of splats on surfaces with closed forms: planes, spheres, leaves in front of them."""

import numpy as np

import fidsplat as fs
from fidsplat.splats.rotations import matrices_to_quaternions


def _disks(means, normals, scale, opacity=0.99, color=(0.6, 0.6, 0.6)) -> fs.SplatCloud:
    means, normals = np.asarray(means, float), np.asarray(normals, float)
    helper = np.where(np.abs(normals[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    a = np.cross(normals, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    quats = matrices_to_quaternions(np.stack([a, np.cross(normals, a), normals], 2))
    n = len(means)
    return fs.SplatCloud(
        means, quats, np.full((n, 2), scale), np.full(n, opacity), colors=np.tile(color, (n, 1))
    )


def plane(point, normal, half=1.0, step=0.05) -> fs.SplatCloud:
    """A square of disks around a point."""
    normal = np.asarray(normal, float) / np.linalg.norm(normal)
    a = np.cross(normal, [0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0])
    a /= np.linalg.norm(a)
    u, v = np.meshgrid(*[np.arange(-half, half + step / 2, step)] * 2)
    means = point + u.reshape(-1, 1) * a + v.reshape(-1, 1) * np.cross(normal, a)
    return _disks(means, np.tile(normal, (len(means), 1)), step)


def sphere(center, radius, count=2000) -> fs.SplatCloud:
    """Disks on a sphere, evenly by the golden angle."""
    k = np.arange(count)
    z = 1 - (2 * k + 1) / count
    angle, across = np.pi * (1 + 5**0.5) * k, np.sqrt(1 - z * z)
    normals = np.stack([across * np.cos(angle), across * np.sin(angle), z], 1)
    return _disks(center + radius * normals, normals, 1.3 * radius * np.sqrt(4 * np.pi / count) / 2)


def leaves(center, spread, count, scale=0.02, seed=1) -> fs.SplatCloud:
    """Disks of random places and directions."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return _disks(center + spread * rng.normal(size=(count, 3)), normals, scale, color=(0.1, 0.5, 0.1))
