"""Greenhouse: rows of plants on benches under glass, with AprilTags and QR codes, and its MuJoCo model for
collisions. z is up; rows run along x, the first at y = 0."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.capture.environment import Gradient
from fidsplat.markers import marker
from fidsplat.scenes import PlacedMarker, Scene
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import rigid_matrix
from fidsplat.util.arguments import whole_number
from fidsplat.util.errors import InputError
from fidsplat.worlds.plants import KINDS, disks

MAX_COUNT = 200
"""rows, and plants per row"""
AISLE = 1.5
"""metres between rows"""
SPACING = 0.6
"""metres between plants"""
BENCH = 0.4, 0.5
"""metres: width and height"""
PLANT_SPLATS = 500
"""splats of a generated plant"""
END = 1.6
"""metres of floor beyond the ends of the rows"""
ROOF = 3.2
PANEL = 0.1
"""metres between the disks of a panel, at most"""
TAG, QR = 0.16, 0.24
"""metres: edges of the codes"""
TAG_HEIGHT, TAG_SPACING = 0.3, 1.8
"""metres: tags are on the sides of the benches, below the leaves"""
DARK, EARTH, FRAME = (0.2, 0.16, 0.12), (0.45, 0.4, 0.34), (0.75, 0.77, 0.78)


@dataclass(frozen=True)
class GreenhouseSettings:
    """Size and seed of a greenhouse.

    Raises:
        InputError: numbers out of range.
    """

    rows: int = 8
    """Number of rows of plants."""
    plants: int = 12
    """Number of plants in each row."""
    seed: int = 0
    """Seed of the plants and the floor."""
    mixture: str | None = None
    """Mixture of the markers: exact, fitted, facets or paper. By default exact."""

    def __post_init__(self) -> None:
        for name, highest in (("rows", MAX_COUNT), ("plants", MAX_COUNT), ("seed", 2**32 - 1)):
            whole_number(f"{name} of a greenhouse", getattr(self, name), int(name != "seed"), highest)


@dataclass(frozen=True)
class Greenhouse(GreenhouseSettings):
    """Rows of plants under glass; equal settings make equal greenhouses on every machine."""

    stock: Mapping[str, Sequence[SplatCloud]] | None = field(default=None, compare=False, repr=False)
    """Plants by kind, one kind per row, each in its own frame (`fidsplat.worlds.plants.load_plants`); None
    generates them."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.stock is not None and not (self.stock and all(self.stock.values())):
            raise InputError("stock must have at least one plant of each kind, got none; None generates them")

    @property
    def length(self) -> float:
        """Length of a row in metres."""
        return self.plants * SPACING

    @property
    def row_positions(self) -> list[float]:
        """y coordinate of each row in metres."""
        return [AISLE * row for row in range(self.rows)]

    @cached_property
    def scene(self) -> Scene:
        """The complete scene, with a camera that looks into the first aisle."""
        eye = (-END + 0.2, AISLE / 2, 0.9)
        camera = Camera.look_at(
            1280, 720, math.radians(70), eye, (self.length / 2, AISLE / 2, 0.7), (0, 0, 1)
        )
        sky = Gradient(top=(0.55, 0.7, 0.9), bottom=(0.35, 0.4, 0.35), up=(0.0, 0.0, 1.0))
        clouds = (self._ground(), self._benches(), self._plants(), self._roof())
        return Scene(clouds, camera, tuple(self.markers), background=sky)

    @cached_property
    def markers(self) -> list[PlacedMarker]:
        """AprilTags 36h11 with ids from 0 on both sides and ends of every bench, and a QR code above each
        row's near end."""
        markers, number = [], 0
        half = BENCH[0] / 2 + 0.005
        for row, y in enumerate(self.row_positions):
            places = [((-0.005, y), (-1, 0)), ((self.length + 0.005, y), (1, 0))]
            count = max(1, round(self.length / TAG_SPACING))
            for k in range(count):
                x = (k + 0.5) * self.length / count
                places += [((x, y - half), (0, -1)), ((x, y + half), (0, 1))]
            for place, towards in places:
                pose = facing((*place, TAG_HEIGHT), towards)
                tag = marker(f"apriltag:36h11:{number % 587}", TAG, self.mixture)
                markers.append(PlacedMarker(tag, pose))
                number += 1
            code = marker(f"qr:row {row + 1}", QR, self.mixture)
            markers.append(PlacedMarker(code, facing((-0.02, y, 0.75), (-1, 0))))
        return markers

    def _plants(self) -> SplatCloud:
        rng = np.random.default_rng([self.seed, 1])
        kinds = list(KINDS if self.stock is None else self.stock)
        plants = []
        for row, y in enumerate(self.row_positions):
            kind = kinds[row % len(kinds)]
            for k in range(self.plants):
                azimuth = rng.uniform(0, 2 * math.pi)
                foot = ((k + 0.5) * SPACING + rng.normal(0, 0.03), y + rng.normal(0, 0.02), BENCH[1])
                pose = rigid_matrix(foot, (math.cos(azimuth / 2), 0, 0, math.sin(azimuth / 2)))
                plant = (
                    KINDS[kind](rng).splats(PLANT_SPLATS)
                    if self.stock is None
                    else _one_of(self.stock[kind], rng)
                )
                plants.append(plant.transformed(pose))
        return SplatCloud.concatenate(plants)

    def _ground(self) -> SplatCloud:
        rng = np.random.default_rng([self.seed, 2])
        low, high = (-END, -AISLE), (self.length + END, self.row_positions[-1] + AISLE)
        sides = [max(2, round((b - a) / 0.15)) for a, b in zip(low, high, strict=True)]
        x, y = np.meshgrid(*(np.linspace(a, b, n) for a, b, n in zip(low, high, sides, strict=True)))
        count = x.size
        centers = np.stack([x.ravel(), y.ravel(), np.zeros(count)], 1)
        centers[:, :2] += rng.uniform(-0.04, 0.04, (count, 2))
        colors = np.asarray(EARTH) * rng.uniform(0.75, 1.2, (count, 1))
        sizes = rng.uniform(0.07, 0.11, (count, 2))
        up = np.tile([0.0, 0, 1], (count, 1))
        azimuths = rng.uniform(0, math.pi, count)
        along = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros(count)], 1)
        return disks(centers, along, up, sizes, colors)

    def _benches(self) -> SplatCloud:
        width, height = BENCH
        benches = []
        for y in self.row_positions:
            middle = self.length / 2
            benches.append(_panel((middle, y, height), (1, 0, 0), (0, 1, 0), self.length, width, DARK))
            for side in (-1, 1):
                at = (middle, y + side * width / 2, height / 2)
                benches.append(_panel(at, (1, 0, 0), (0, 0, 1), self.length, height, FRAME))
                at = (middle + side * self.length / 2, y, height / 2)
                benches.append(_panel(at, (0, 1, 0), (0, 0, 1), width, height, FRAME))
        return SplatCloud.concatenate(benches)

    def _roof(self) -> SplatCloud:
        """Glass roof and its frame."""
        low, high = -AISLE, self.row_positions[-1] + AISLE
        middle, across = (low + high) / 2, high - low
        long = self.length + 2 * END
        panes = [
            _panel((self.length / 2, middle, ROOF), (1, 0, 0), (0, 1, 0), long, across, FRAME, opacity=0.04)
        ]
        for x in np.linspace(-END, self.length + END, max(2, round(long / 2))):
            panes.append(_panel((x, middle, ROOF - 0.02), (1, 0, 0), (0, 1, 0), 0.06, across, FRAME))
            for y in (low, high):
                panes.append(_panel((x, y, ROOF / 2), (1, 0, 0), (0, 0, 1), 0.06, ROOF, FRAME))
        return SplatCloud.concatenate(panes)

    def mjcf(self, robot: str = "") -> str:
        """MuJoCo model of the floor and the benches for collisions, and of a robot if its XML is given."""
        width, height = BENCH
        boxes = "\n".join(
            f'    <geom name="bench {row + 1}" type="box" pos="{self.length / 2:g} {y:g} {height / 2:g}" '
            f'size="{self.length / 2:g} {width / 2:g} {height / 2:g}"/>'
            for row, y in enumerate(self.row_positions)
        )
        return (
            '<mujoco model="greenhouse">\n'
            '  <option timestep="0.002" integrator="implicitfast" cone="elliptic" impratio="10"/>\n'
            f'  <worldbody>\n    <geom name="floor" type="plane" size="0 0 1"/>\n{boxes}\n{robot}'
            "  </worldbody>\n</mujoco>\n"
        )


def _one_of(plants: Sequence[SplatCloud], rng: np.random.Generator) -> SplatCloud:
    return plants[int(rng.integers(len(plants)))]


def facing(place: tuple[float, float, float], towards: tuple[float, float]) -> np.ndarray:
    """Pose (4, 4) of an upright marker that faces the horizontal direction (x, y); z is up."""
    normal = np.array([-towards[0], -towards[1], 0.0])  # a marker is visible from its -z
    down = np.array([0.0, 0.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, normal), down, normal], axis=1)
    pose[:3, 3] = place
    return pose


def _panel(middle, along, across, length: float, width: float, color, opacity: float = 0.95) -> SplatCloud:
    """Rectangle of one colour, made of overlapping disks."""
    step = min(PANEL, width / 2)
    counts = [max(1, round(size / step)) for size in (length, width)]
    u, v = (
        ((np.arange(count) + 0.5) / count - 0.5) * size
        for count, size in zip(counts, (length, width), strict=True)
    )
    first, second = np.asarray(along, float), np.asarray(across, float)
    centers = np.asarray(middle) + u[:, None, None] * first + v[None, :, None] * second
    count = centers.shape[0] * centers.shape[1]
    rows = np.ones((count, 1))
    sizes = rows * [0.6 * length / counts[0], 0.6 * width / counts[1]]
    return disks(
        centers.reshape(-1, 3), rows * first, rows * np.cross(first, second), sizes, rows * color, opacity
    )
