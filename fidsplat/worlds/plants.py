"""Plants of disks, grown from a seed: each a cloud in its own frame, z up, its foot at the origin."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fidsplat.formats import load_ply
from fidsplat.sim.poses import quaternions_of
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError

Colour = Sequence[float]
_UP = np.array([0.0, 0.0, 1.0])


def disks(
    centers: np.ndarray,
    along: np.ndarray,
    normals: np.ndarray,
    sizes: np.ndarray,
    colors: np.ndarray,
    opacity: float = 0.95,
) -> SplatCloud:
    """Disks at centers (n, 3) with normals (n, 3), whose first axis lies along (n, 3) and whose standard
    deviations are sizes (n, 2); colours (n, 3)."""
    normal = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = along - (along * normal).sum(1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    turns = np.stack([first, np.cross(normal, first), normal], axis=2)
    return SplatCloud(
        centers, quaternions_of(turns), sizes, np.full(len(centers), opacity), colors=np.clip(colors, 0, 1)
    )


def tomato(rng: np.random.Generator) -> SplatCloud:
    """A stem of 1 to 1.4 m, feathered leaves, trusses of fruits."""
    height = rng.uniform(1.0, 1.4)
    stem = _stem(rng, height, 0.01)
    leaves = _leaves(rng, height, 26, length=0.16, width=0.06, droop=0.5, parts=4)
    return _whole(stem, leaves, _fruits(rng, height, 9, 0.03, (0.8, 0.15, 0.08)))


def cucumber(rng: np.random.Generator) -> SplatCloud:
    """A stem of 1.3 to 1.7 m, large leaves, long hanging fruits."""
    height = rng.uniform(1.3, 1.7)
    stem = _stem(rng, height, 0.009)
    leaves = _leaves(rng, height, 20, length=0.14, width=0.12, droop=0.3, parts=3)
    return _whole(stem, leaves, _fruits(rng, height, 5, 0.022, (0.16, 0.38, 0.1), stretch=4.0))


def lettuce(rng: np.random.Generator) -> SplatCloud:
    """A rosette of 0.3 m."""
    count = 40
    around = rng.uniform(0, 2 * math.pi, count)
    rise = np.linspace(0.15, 1.3, count) + rng.normal(0, 0.08, count)
    outward = np.stack([np.cos(around), np.sin(around), np.zeros(count)], 1)
    along = np.cos(rise)[:, None] * outward + np.sin(rise)[:, None] * _UP
    reach = rng.uniform(0.06, 0.14, count)
    centers = along * reach[:, None] + [0, 0, 0.02]
    normals = -np.sin(rise)[:, None] * outward + np.cos(rise)[:, None] * _UP
    sizes = np.stack([0.5 * reach, 0.45 * reach], 1)
    return disks(centers, along, normals, sizes, _greens(rng, count, (0.35, 0.6, 0.18)))


KINDS: dict[str, Callable[[np.random.Generator], SplatCloud]] = {
    "tomato": tomato,
    "cucumber": cucumber,
    "lettuce": lettuce,
}


def load_plants(folder: str | Path) -> dict[str, list[SplatCloud]]:
    """Plants that are there, by kind: KIND-NUMBER.ply of a folder, each in its own frame, z up, its foot at
    the origin.

    Raises InputError where there is none, or one cannot be read.
    """
    found: dict[str, list[SplatCloud]] = {}
    files = {file: re.fullmatch(r"(.+)-(\d+)", file.stem) for file in Path(folder).glob("*.ply")}
    numbered = [(match[1], int(match[2]), file) for file, match in files.items() if match]
    for kind, _, file in sorted(numbered):
        found.setdefault(kind, []).append(_plain(load_ply(file)))
    if not found:
        raise InputError(
            f"{folder} holds no plants; they are KIND-NUMBER.ply, e.g. tomato-0.ply, as "
            "`fidsplat experiment plants` writes them"
        )
    return found


def _plain(cloud: SplatCloud) -> SplatCloud:
    """With colours in place of SH of degree 0, which would make SH of a whole scene."""
    colors = cloud.plain_colors
    if cloud.sh is None or colors is None:
        return cloud
    thick = () if cloud.thickness is None else (cloud.thickness,)
    scales = np.column_stack([cloud.scales, *thick])
    return SplatCloud(cloud.means, cloud.quats, scales, cloud.opacities, colors, origin=cloud.origin)


def _whole(*parts: SplatCloud) -> SplatCloud:
    return SplatCloud.concatenate(parts)


def _greens(rng: np.random.Generator, count: int, colour: Colour) -> np.ndarray:
    """Shades of a colour, each a little lighter or darker."""
    return np.asarray(colour) * rng.uniform(0.7, 1.25, (count, 1)) + rng.normal(0, 0.02, (count, 3))


def _stem(rng: np.random.Generator, height: float, radius: float) -> SplatCloud:
    """Upright disks, crossed, so that it is seen from every side."""
    count = math.ceil(height / 0.05)
    z = np.repeat((np.arange(count) + 0.5) * height / count, 2)
    sway = 0.03 * np.sin(z * rng.uniform(2, 5) + rng.uniform(0, 6))
    centers = np.stack([sway, 0.6 * sway[::-1], z], 1)
    across = np.tile([[1.0, 0, 0], [0, 1.0, 0]], (count, 1))
    sizes = np.tile([0.6 * height / count, radius], (2 * count, 1))
    return disks(
        centers, np.tile(_UP, (2 * count, 1)), across, sizes, _greens(rng, 2 * count, (0.3, 0.45, 0.15))
    )


def _leaves(
    rng: np.random.Generator, height: float, count: int, length: float, width: float, droop: float, parts: int
) -> SplatCloud:
    """Leaves around a stem, spiralling up, each of some disks in a row that bends down."""
    k = np.arange(count)
    around = k * 2.4 + rng.normal(0, 0.3, count)  # the golden angle
    z = height * (0.15 + 0.85 * (k + rng.uniform(0, 1, count)) / count)
    scale = rng.uniform(0.7, 1.2, count) * (1.15 - 0.5 * z / height)
    outward = np.stack([np.cos(around), np.sin(around), np.zeros(count)], 1)
    found = []
    for part in range(parts):
        share = (part + 0.5) / parts
        bend = rng.uniform(0.1, 0.4, count) - droop * share * 2
        along = np.cos(bend)[:, None] * outward + np.sin(bend)[:, None] * _UP
        reach = (length * scale * 2 * share)[:, None]
        centers = outward * reach + np.stack([0 * z, 0 * z, z - droop * reach[:, 0] * share], 1)
        normals = np.cross(np.cross(along, _UP), along) + rng.normal(0, 0.15, (count, 3))
        wide = width * scale * (1 - 0.5 * abs(2 * share - 1))
        sizes = np.stack([length * scale / parts, 0.5 * wide], 1)
        found.append(disks(centers, along, normals, sizes, _greens(rng, count, (0.16, 0.42, 0.12))))
    return _whole(*found)


def _fruits(
    rng: np.random.Generator, height: float, count: int, radius: float, colour: Colour, stretch: float = 1.0
) -> SplatCloud:
    """Balls, or what hangs longer by `stretch`: a shell of twelve disks each."""
    rays = np.array([[0, a, b] for a in (1, -1) for b in (1.618, -1.618)])
    rays = np.concatenate([rays, rays[:, [2, 0, 1]], rays[:, [1, 2, 0]]])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)  # the corners of an icosahedron
    around = rng.uniform(0, 2 * math.pi, count)
    feet = np.stack([0.07 * np.cos(around), 0.07 * np.sin(around), height * rng.uniform(0.2, 0.75, count)], 1)
    size = radius * rng.uniform(0.8, 1.2, count)
    shape = np.array([1.0, 1.0, stretch])
    centers = feet[:, None] + size[:, None, None] * rays * shape
    normals = np.broadcast_to(rays / shape, centers.shape).reshape(-1, 3)
    along = np.cross(normals, [0.3, 0.5, 0.8])
    wide = np.repeat(0.75 * size * stretch**0.5, 12)
    return disks(
        centers.reshape(-1, 3),
        along,
        normals,
        np.stack([wide, wide], 1),
        _greens(rng, 12 * count, colour),
    )
