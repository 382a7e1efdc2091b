"""Markers, planes and viewpoints of the paper's section 4.1, and two protocols of tilts."""

from __future__ import annotations

import math
import random
import string
from dataclasses import dataclass

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.util.errors import InputError, unknown
from fidsplat.util.response import linear_light

SEED = 0
MARKERS = 5
"""markers of each category"""
PLANE = 2.0
"""edge in metres of a marker's plane, including the quiet zone"""
BACKGROUND = 128 / 255
"""grey background: a display value that 8 bits represent exactly"""
BACKGROUND_LIGHT = float(linear_light(np.array(BACKGROUND), "srgb"))
"""linear light of the background"""


@dataclass(frozen=True)
class Category:
    """Category of markers, a row of the paper's tables."""

    name: str
    title: str
    kind: str
    length: int | None = None
    """number of characters of the QR code's text"""
    version: int | None = None
    """version of the QR code"""

    def spec(self, index: int, seed: int = SEED) -> str:
        """Spec of marker 0 to 4: a tag of 36h11, or a QR code of random characters."""
        if self.kind == "apriltag":
            return f"apriltag:36h11:{index}"
        letters = string.ascii_letters + string.digits
        text = "".join(random.Random(f"{seed} {self.name} {index}").choices(letters, k=self.length or 0))
        return f"qr-v{self.version}-L:{text}"


CATEGORIES = {
    category.name: category
    for category in (
        Category("apriltag", "AR Tag", "apriltag"),
        Category("small", "QR Small", "qr", 20, 2),
        Category("medium", "QR Medium", "qr", 100, 5),
        Category("large", "QR Large", "qr", 250, 10),
        Category("huge", "QR Huge", "qr", 1000, 22),
    )
}


def chosen_categories(names: tuple[str, ...]) -> tuple[Category, ...]:
    """Categories by name; all if no name is given. Raises InputError for an unknown name."""
    for name in names:
        if name not in CATEGORIES:
            raise InputError(unknown("category", name, CATEGORIES))
    return tuple(category for name, category in CATEGORIES.items() if not names or name in names)


@dataclass(frozen=True)
class Protocol:
    """Camera of a scan over tilts: azimuth 0, aimed at the centre of the marker."""

    title: str
    pixels: int
    """width and height of the image"""
    distance: float
    """metres"""
    fov: float
    """degrees"""
    module_px: float | None
    """pixels per module in a frontal view; None: the plane is always `PLANE` wide"""

    def module(self, cells: int) -> float:
        """Edge [m] of a module of a marker that has `cells` modules per side, quiet zone included."""
        if self.module_px is None:
            return PLANE / cells
        return self.module_px * self.distance / self.camera(0.0).fx

    def camera(self, tilt: float) -> Camera:
        """Camera above the marker, at ``tilt`` degrees from its normal."""
        a = math.radians(tilt)
        position = (0.0, -self.distance * math.sin(a), -self.distance * math.cos(a))
        return Camera.look_at(self.pixels, self.pixels, math.radians(self.fov), position, (0.0, 0.0, 0.0))


PROTOCOLS = {
    "fixed-plane": Protocol("2 x 2 plane, 800 x 800, 4 m, 50 degrees", 800, 4.0, 50.0, None),
    "fixed-module": Protocol("P*: 8 px a module, 1600 x 1600, 12 m, 17.7 degrees", 1600, 12.0, 17.7, 8.0),
}
"""the paper's plane (the paper's camera is unknown), and planes with equal modules for all codes"""

COLLECTIONS = (3, 5, 9, 17)
"""numbers of training views; each collection contains the smaller ones"""
TEST_VIEWS = 20
MAX_TEST_TILT = 60.0
"""maximum tilt of test views in degrees, which is inside the ring of the largest training set"""

# tilt and azimuth in degrees: front, sides, above and below, diagonals, a wide ring
_VIEWS = (
    (0, 0), (15, 0), (15, 180),
    (30, 90), (30, 270),
    (45, 45), (45, 135), (45, 225), (45, 315),
    *((60, azimuth) for azimuth in range(0, 360, 45)),
)  # fmt: skip


def training_cameras(views: int = COLLECTIONS[-1]) -> list[Camera]:
    """Cameras of a training set of 3, 5, 9 or 17 views. Raises InputError for another number."""
    if views not in COLLECTIONS:
        raise InputError(f"the number of training views must be 3, 5, 9 or 17, got {views}")
    return [_around(tilt, azimuth) for tilt, azimuth in _VIEWS[:views]]


def novel_cameras(category: Category, index: int, seed: int = SEED) -> list[Camera]:
    """Random cameras of a marker, uniform over directions up to 60 degrees from its normal."""
    generator = random.Random(f"{seed} views {category.name} {index}")
    lowest = math.cos(math.radians(MAX_TEST_TILT))
    views = []
    for _ in range(TEST_VIEWS):
        tilt = math.degrees(math.acos(generator.uniform(lowest, 1.0)))
        views.append(_around(tilt, generator.uniform(0.0, 360.0)))
    return views


def _around(tilt: float, azimuth: float) -> Camera:
    protocol = PROTOCOLS["fixed-plane"]
    a, b = math.radians(tilt), math.radians(azimuth)
    towards = np.array([math.sin(a) * math.cos(b), -math.sin(a) * math.sin(b), -math.cos(a)])
    size, fov = protocol.pixels, math.radians(protocol.fov)
    return Camera.look_at(size, size, fov, protocol.distance * towards, (0.0, 0.0, 0.0))
