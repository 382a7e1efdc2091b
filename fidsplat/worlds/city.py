"""Procedural city: streets and houses with windows, of any number of splats, generated in blocks for bounded
memory. y is down; streets are at y = 0."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from fidsplat.cameras import Camera, Trajectory, look_at_matrix
from fidsplat.formats.collect import WINDOW, Rows
from fidsplat.splats.rotations import matrix_to_quaternion
from fidsplat.store.sources import Source
from fidsplat.util.arguments import whole_number

MAX_SPLATS = 2_000_000_000
PITCH = 24.0
"""metres between houses"""
SIDE = 14.0
"""metres: edge of a house"""
WINDOWS = 3.0
"""metres between windows"""
BOARD, EYES = 0.1, 1.7
"""metres: distance of markers from their walls, and height above the street"""
OPACITY = 0.95
OVERLAP = 0.75
"""standard deviation of a splat over the mean distance between splats"""


@dataclass(frozen=True)
class City:
    """Houses on a square grid; equal settings make equal cities on every machine. Raises InputError for
    numbers out of range."""

    splats: int = 20_000_000
    """number of splats"""
    houses: int = 8
    """number of houses along a side"""
    seed: int = 0
    """seed of houses and splats"""

    def __post_init__(self) -> None:
        for name, highest in (("splats", MAX_SPLATS), ("houses", 100), ("seed", 2**32 - 1)):
            whole_number(f"{name} of a city", getattr(self, name), int(name != "seed"), highest)

    @property
    def side(self) -> float:
        """Edge of the city in metres; it extends from 0 along x and z."""
        return PITCH * self.houses

    @property
    def source(self) -> Source:
        """The city as an input of `build_store`, generated while the store is built."""
        widths = {"means": (3,), "quats": (4,), "scales": (2,), "opacities": (), "colors": (3,)}
        columns = {name: (width, np.float32) for name, width in widths.items()}
        rows = Rows(Path(f"city of {self.splats:,}"), self.splats, columns, self._fill)
        return Source(rows, np.zeros(3), repr(self))

    @cached_property
    def _walls(self) -> dict[str, np.ndarray]:
        """Rectangles of the city: corner (w, 3), two edges (w, 3) [m], colour (w, 3), whether they have
        windows (w,)."""
        generator, side = np.random.default_rng(self.seed), self.side
        walls: list = [([0, 0, 0], [side, 0, 0], [0, 0, side], [0.32, 0.31, 0.3], False)]
        for i in range(self.houses):
            for j in range(self.houses):
                height = float(generator.uniform(6, 24))
                color = generator.uniform(0.35, 0.8, 3) * [1.0, 0.9, 0.8]
                x, z = PITCH * i + (PITCH - SIDE) / 2, PITCH * j + (PITCH - SIDE) / 2
                for at, edge in (
                    ([x, 0, z], [SIDE, 0, 0]),
                    ([x + SIDE, 0, z], [0, 0, SIDE]),
                    ([x + SIDE, 0, z + SIDE], [-SIDE, 0, 0]),
                    ([x, 0, z + SIDE], [0, 0, -SIDE]),
                ):
                    walls.append((at, edge, [0, -height, 0], color, True))
                walls.append(([x, -height, z], [SIDE, 0, 0], [0, 0, SIDE], color * 0.5, False))
        *rows, windows = zip(*walls, strict=True)
        arrays = (np.array(row, np.float64) for row in rows)
        return dict(zip(("corner", "across", "up", "color"), arrays, strict=True)) | {
            "windows": np.array(windows)
        }

    def marker_poses(self, count: int) -> np.ndarray:
        """Poses (count, 4, 4), world from marker, on walls at camera height, evenly spread, facing the
        streets."""
        walls, houses = self._walls, np.flatnonzero(self._walls["windows"])
        poses, rows = np.tile(np.eye(4), (count, 1, 1)), -(-count // len(houses))
        for number, pose in enumerate(poses):
            row, wall = divmod(number, len(houses))
            across = walls["across"][houses[wall]]
            along, down = across / np.linalg.norm(across), np.array([0.0, 1.0, 0.0])
            into = np.cross(along, down)
            pose[:3, :3] = np.stack([along, down, into], axis=1)
            pose[:3, 3] = walls["corner"][houses[wall]] + (row + 0.5) / rows * across - BOARD * into
            pose[1, 3] -= EYES
        return poses

    @cached_property
    def _frames(self) -> np.ndarray:
        """Quaternions (w, 4) with tangents along the edges."""
        walls = self._walls
        u = walls["across"] / np.linalg.norm(walls["across"], axis=1, keepdims=True)
        v = walls["up"] / np.linalg.norm(walls["up"], axis=1, keepdims=True)
        rotations = np.stack([u, v, np.cross(u, v)], axis=2)
        return np.array([matrix_to_quaternion(rotation) for rotation in rotations])

    def _fill(self, first: int, arrays: dict[str, np.ndarray]) -> None:
        """Fill arrays with the splats from `first` on, generated in blocks of `WINDOW`."""
        done, count = 0, len(arrays["means"])
        while done < count:
            block, start = divmod(first + done, WINDOW)
            take = min(WINDOW - start, count - done)
            for name, splats in self._block(block).items():
                arrays[name][done : done + take] = splats[start : start + take]
            done += take

    def _block(self, number: int) -> dict[str, np.ndarray]:
        generator, walls = np.random.default_rng([self.seed, number]), self._walls
        widths, heights = (np.linalg.norm(walls[edge], axis=1) for edge in ("across", "up"))
        areas = widths * heights
        spacing = math.sqrt(areas.sum() / self.splats)
        wall = np.searchsorted(np.cumsum(areas / areas.sum())[:-1], generator.random(WINDOW))
        a, b = generator.random((2, WINDOW))
        means = walls["corner"][wall] + a[:, None] * walls["across"][wall] + b[:, None] * walls["up"][wall]
        x, y = a * widths[wall], b * heights[wall]
        stains = 0.06 * (np.sin(0.7 * x + 1.3 * y) + np.sin(2.1 * x - 0.4 * y + wall))
        colors = walls["color"][wall] * (1 + stains + generator.normal(0, 0.03, WINDOW))[:, None]
        pane = (np.abs(x % WINDOWS - WINDOWS / 2) < 0.6) & (np.abs(y % WINDOWS - WINDOWS / 2) < 0.8)
        pane &= walls["windows"][wall]
        colors[pane] = [0.1, 0.14, 0.2]
        line = ~walls["windows"][wall] & (wall == 0) & (np.abs(x % PITCH) < 0.15) & (y % 4 < 2)
        colors[line] = 0.85
        scales = OVERLAP * spacing * np.exp(generator.normal(0, 0.2, (WINDOW, 2)))
        arrays = {
            "means": means,
            "quats": self._frames[wall],
            "scales": scales,
            "colors": np.clip(colors, 0, 1),
        }
        return arrays | {"opacities": np.full(WINDOW, OPACITY, np.float32)}


def flight(city: City) -> tuple[Camera, Trajectory]:
    """Camera of 1280 x 720, and a trajectory of 8 s (world to camera) through a street and above the
    roofs."""
    street, side = PITCH * (city.houses // 2), city.side
    views = [
        (0.0, (street, -1.7, -4.0), (street, -2.0, 40.0)),
        (3.0, (street, -2.5, side * 0.4), (street, -4.0, side)),
        (5.0, (street - 6.0, -32.0, side * 0.4), (street, -4.0, side)),
        (8.0, (-0.3 * side, -0.6 * side, -0.4 * side), (side / 2, 0.0, side / 2)),
    ]
    poses = [look_at_matrix(position, target) for _, position, target in views]
    camera = Camera.look_at(1280, 720, math.radians(70.0), views[0][1], views[0][2])
    return camera, Trajectory([time for time, _, _ in views], np.stack(poses))
