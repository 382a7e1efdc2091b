"""Plants: procedural meshes, and splat files; z up, the foot at the origin, in metres."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.formats import load_ply
from fidsplat.splats.arrays import all_scales
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import matrices_to_quaternions
from fidsplat.util.errors import InputError

LEAF, STALK, TOMATO, CUCUMBER = (0.2, 0.46, 0.13), (0.38, 0.5, 0.2), (0.85, 0.13, 0.07), (0.16, 0.4, 0.1)
LETTUCE = (0.38, 0.62, 0.16)
GOLDEN = 2.39996
"""radians from one leaf to the next"""


def disks(
    centers: np.ndarray,
    along: np.ndarray,
    normals: np.ndarray,
    sizes: np.ndarray,
    colors: np.ndarray,
    opacity: float = 0.95,
) -> SplatCloud:
    """Splats of plain colours.

    Args:
        centers: (n, 3).
        along: (n, 3) directions of the first axis, projected into each disk's plane.
        normals: (n, 3).
        sizes: (n, 2) standard deviations in metres.
        colors: (n, 3).
        opacity: of every disk.
    """
    normal = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    first = along - (along * normal).sum(1, keepdims=True) * normal
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normal, first), normal], axis=2)
    return SplatCloud(
        centers,
        matrices_to_quaternions(frames),
        sizes,
        np.full(len(centers), opacity),
        colors=np.clip(colors, 0, 1),
    )


@dataclass(frozen=True, eq=False)
class Mesh:
    """Quadrilaterals with a colour per vertex."""

    vertices: np.ndarray
    """(n, 3) metres"""
    quads: np.ndarray
    """(m, 4) vertex indices around each face"""
    colors: np.ndarray
    """(n, 3) unlit surface colours in display space"""

    def splats(self, count: int, seed: int = 0) -> SplatCloud:
        """Cover the surface evenly with `count` disks."""
        rng = np.random.default_rng(seed)
        # each quadrilateral as two triangles
        corners = np.concatenate([self.quads[:, [0, 1, 2]], self.quads[:, [0, 2, 3]]])
        at, color = self.vertices[corners], self.colors[corners]
        normals = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
        area = np.linalg.norm(normals, axis=1) / 2
        # stratified by area: independent samples would leave holes
        steps = (np.arange(count) + rng.uniform()) / count * area.sum()
        face = np.minimum(np.searchsorted(np.cumsum(area), steps), len(area) - 1)
        fraction = rng.uniform(size=(count, 2))
        fraction = np.where(fraction.sum(1, keepdims=True) > 1, 1 - fraction, fraction)
        weights = np.column_stack([1 - fraction.sum(1), fraction])[:, :, None]
        size = 0.7 * math.sqrt(area.sum() / count)
        return disks(
            (at[face] * weights).sum(1),
            at[face, 1] - at[face, 0],
            normals[face],
            np.full((count, 2), size),
            (color[face] * weights).sum(1),
        )


def tomato(rng: np.random.Generator) -> Mesh:
    """Tomato plant: a stem of 1.1 to 1.4 m, leaves of seven leaflets, trusses of fruits."""
    height = rng.uniform(1.1, 1.4)
    stem = _stem(rng, height)
    parts = [_tube(stem, 0.008, STALK)]
    for at, azimuth, fraction in _nodes(rng, stem, 18):
        length = rng.uniform(0.26, 0.34) * (1.15 - 0.5 * fraction)
        rachis = _placed(_arc(length, rng.uniform(0.2, 0.5), 1.3), at, azimuth)
        parts.append(_tube(rachis, 0.003, STALK))
        shade = _shade(rng, LEAF)
        for where, side in ((0.4, 1.1), (0.65, 1.0), (0.85, 0.9)):
            foot = rachis[round(where * (len(rachis) - 1))]
            for sign in (-1, 1):
                parts.append(
                    _blade(rng, foot, azimuth + sign * side, 0.45 * length * (1.2 - 0.5 * where), 0.55, shade)
                )
        parts.append(_blade(rng, rachis[-1], azimuth, 0.45 * length, 0.6, shade))
    for at, azimuth, _ in _nodes(rng, stem, 4, 0.25, 0.7):
        truss = _placed(_arc(0.13, 0.3, 2.2), at, azimuth)
        parts.append(_tube(truss, 0.003, STALK))
        for foot in truss[2::2]:
            radius = rng.uniform(0.02, 0.032)
            parts.append(
                _ball(foot - [0, 0, radius], (radius, radius, 0.9 * radius), _shade(rng, TOMATO, 0.1))
            )
    return _merged(parts)


def cucumber(rng: np.random.Generator) -> Mesh:
    """Cucumber plant: a stem of 1.3 to 1.7 m, broad leaves on stalks, long hanging fruits."""
    height = rng.uniform(1.3, 1.7)
    stem = _stem(rng, height)
    parts = [_tube(stem, 0.007, STALK)]
    for at, azimuth, fraction in _nodes(rng, stem, 20):
        stalk = _placed(_arc(rng.uniform(0.1, 0.16) * (1.15 - 0.4 * fraction), 0.6, 0.6), at, azimuth)
        parts.append(_tube(stalk, 0.004, STALK))
        size = rng.uniform(0.18, 0.26) * (1.15 - 0.5 * fraction)
        parts.append(_blade(rng, stalk[-1], azimuth, size, 1.05, _shade(rng, LEAF), lobes=0.18, droop=0.9))
    for at, azimuth, _ in _nodes(rng, stem, 5, 0.3, 0.75):
        stalk = _placed(_arc(0.07, 0.2, 2.0), at, azimuth)
        half = rng.uniform(0.08, 0.13)
        parts.append(_tube(stalk, 0.003, STALK))
        parts.append(_ball(stalk[-1] - [0, 0, half], (0.02, 0.02, half), _shade(rng, CUCUMBER, 0.1)))
    return _merged(parts)


def lettuce(rng: np.random.Generator) -> Mesh:
    """Lettuce: a rosette of 0.3 m with wavy leaves, upright inside."""
    parts, count = [], 26
    for k in range(count):
        rise = 0.15 + 1.2 * k / count + rng.normal(0, 0.05)
        length = rng.uniform(0.15, 0.19) * (1.0 - 0.35 * k / count)
        parts.append(
            _blade(
                rng,
                np.array([0, 0, 0.01]),
                GOLDEN * k,
                length,
                0.9,
                _shade(rng, LETTUCE),
                rise=rise,
                droop=0.5,
                waves=0.2,
            )
        )
    return _merged(parts)


KINDS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "tomato": tomato,
    "cucumber": cucumber,
    "lettuce": lettuce,
}
"""mesh generators by kind"""


def load_plants(folder: str | Path) -> dict[str, list[SplatCloud]]:
    """Plants of a folder with KIND-NUMBER.ply, by kind; each in its own frame, z up, its foot at the origin.

    Raises InputError if there is no such file, or one cannot be read.
    """
    stock: dict[str, list[SplatCloud]] = {}
    files = {file: re.fullmatch(r"(.+)-(\d+)", file.stem) for file in Path(folder).glob("*.ply")}
    numbered = [(match[1], int(match[2]), file) for file, match in files.items() if match]
    for kind, _, file in sorted(numbered):
        stock.setdefault(kind, []).append(_plain(load_ply(file)))
    if not stock:
        raise InputError(
            f"{folder} must have plants as KIND-NUMBER.ply, e.g. tomato-0.ply, got none; "
            "`fidsplat experiment plants` writes them"
        )
    return stock


def _plain(cloud: SplatCloud) -> SplatCloud:
    """The cloud with colours instead of SH of degree 0: a single cloud with SH would give the complete scene
    SH."""
    colors = cloud.plain_colors
    if cloud.sh is None or colors is None:
        return cloud
    return SplatCloud(
        cloud.means, cloud.quats, all_scales(cloud), cloud.opacities, colors, origin=cloud.origin
    )


def _shade(rng: np.random.Generator, color: Sequence[float], spread: float = 0.2) -> np.ndarray:
    return np.clip(np.asarray(color) * (1 + rng.uniform(-spread, spread)), 0, 1)


def _stem(rng: np.random.Generator, height: float) -> np.ndarray:
    """(24, 3) centre line of a swaying stem."""
    z = np.linspace(0, height, 24)
    phase, pace = rng.uniform(0, 2 * math.pi, 2), rng.uniform(3, 6, 2)
    sway = 0.02 * (np.sin(pace * z[:, None] + phase) - np.sin(phase))
    return np.column_stack([sway, z])


def _nodes(
    rng: np.random.Generator, stem: np.ndarray, count: int, low: float = 0.12, high: float = 0.98
) -> list[tuple[np.ndarray, float, float]]:
    """Position, azimuth and relative height of each leaf base on a stem."""
    fractions = np.linspace(low, high, count) + rng.normal(0, 0.01, count)
    azimuths = GOLDEN * np.arange(count) + rng.uniform(0, 2 * math.pi) + rng.normal(0, 0.25, count)
    line = [np.interp(fractions, np.linspace(0, 1, len(stem)), axis) for axis in stem.T]
    return list(zip(np.column_stack(line), azimuths.tolist(), fractions.tolist(), strict=True))


def _arc(length: float, rise: float, bend: float, points: int = 8) -> np.ndarray:
    """Points (n, 3) of an arc that starts at the origin along x with the elevation `rise` and bends down by
    `bend`, in radians."""
    angles = rise - bend * np.linspace(0, 1, points - 1) ** 1.5
    steps = length / (points - 1) * np.column_stack([np.cos(angles), 0 * angles, np.sin(angles)])
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def _placed(points: np.ndarray, at: np.ndarray, rotation: float) -> np.ndarray:
    """Points (..., 3) rotated about z, then translated."""
    c, s = math.cos(rotation), math.sin(rotation)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + at


def _tube(line: np.ndarray, radius: float, color: Sequence[float]) -> Mesh:
    """Tapered tube along a line (n, 3), with six sides."""
    along = np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.cross(along, [0.35, 0.9, 0.25])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    around = np.arange(6) * 2 * math.pi / 6
    thick = radius * np.linspace(1, 0.6, len(line))
    ring = (
        np.cos(around)[:, None] * across[:, None] + np.sin(around)[:, None] * np.cross(along, across)[:, None]
    )
    return _grid(line[:, None] + thick[:, None, None] * ring, np.asarray(color), closed=True)


def _blade(
    rng: np.random.Generator,
    foot: np.ndarray,
    azimuth: float,
    length: float,
    aspect: float,
    color: np.ndarray,
    rise: float = 0.35,
    droop: float = 1.0,
    lobes: float = 0.08,
    waves: float = 0.05,
) -> Mesh:
    """Leaf that grows from its foot towards an azimuth [rad], folded and darker at its midrib. aspect: width
    divided by length."""
    rows, columns = 11, 9
    u, v = np.linspace(0, 1, rows)[:, None], np.linspace(-1, 1, columns)
    half = aspect / 2 * length * np.sin(math.pi * np.clip(u, 0.02, 0.99) ** 0.75) ** 0.8
    half = half * (1 + lobes * np.cos(6 * math.pi * u))
    middle = _arc(length, rise, droop, rows)[:, None]
    phase = rng.uniform(0, 2 * math.pi)
    lift = half * (0.25 * np.abs(v) + waves * np.abs(v) ** 2 * np.sin(4 * math.pi * u + 3 * v + phase))
    points = middle + np.stack([0 * lift, half * v, lift], axis=-1)
    light = 1 + 0.18 * np.abs(v) - 0.08 * np.cos(8 * math.pi * (u - 0.3 * np.abs(v)))
    return _grid(_placed(points, foot, azimuth), np.clip(color * light[..., None], 0, 1))


def _ball(middle: np.ndarray, radii: Sequence[float], color: np.ndarray) -> Mesh:
    rows, columns = 9, 12
    down = np.linspace(0.02, math.pi - 0.02, rows)[:, None]
    around = np.arange(columns) * 2 * math.pi / columns
    rays = np.stack(
        [np.sin(down) * np.cos(around), np.sin(down) * np.sin(around), np.cos(down) + 0 * around], -1
    )
    return _grid(middle + rays * radii, color, closed=True)


def _grid(points: np.ndarray, color: np.ndarray, closed: bool = False) -> Mesh:
    """Surface through a grid of points (rows, columns, 3). closed: whether the last column joins the
    first."""
    rows, columns = points.shape[:2]
    number = np.arange(rows * columns).reshape(rows, columns)
    if closed:
        number = np.column_stack([number, number[:, 0]])
    quads = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], -1).reshape(-1, 4)
    return Mesh(points.reshape(-1, 3), quads, np.broadcast_to(color, points.shape).reshape(-1, 3))


def _merged(parts: Sequence[Mesh]) -> Mesh:
    firsts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    quads = [part.quads + first for part, first in zip(parts, firsts, strict=True)]
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate(quads),
        np.concatenate([part.colors for part in parts]),
    )
