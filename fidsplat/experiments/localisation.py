"""Localisation accuracy: pose errors of one marker by distance and tilt."""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.methods import Painter, plain_marker
from fidsplat.experiments.setup import CATEGORIES, Category
from fidsplat.markers import Marker
from fidsplat.util import interrupts
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.readback import corner_error, own_code

NAME = "localisation"
LOCATED = ("apriltag", "small")
SIZE = 0.16
"""edge of the code in metres"""
WIDTH, HEIGHT, FOV = 1280, 720, 60.0
DISTANCES = (0.5, 1.0, 2.0, 3.0, 4.0)
"""metres"""
TILTS = (0.0, 20.0, 40.0, 60.0, 70.0)
"""degrees"""
QUICK_DISTANCES, QUICK_TILTS = (0.5, 1.0, 2.0), (0.0, 40.0, 60.0)


def localisation_points(
    categories: Iterable[Category],
    methods: Iterable[str],
    distances: Iterable[float] = DISTANCES,
    tilts: Iterable[float] = TILTS,
    markers: int = 5,
) -> list[dict]:
    """Points of the experiment: a marker and a method, at every distance and tilt."""
    distances, tilts = list(distances), list(tilts)
    return [
        {"category": c.name, "index": i, "method": m, "distances": distances, "tilts": tilts}
        for c in categories
        for i in range(markers)
        for m in methods
    ]


def measure_localisation(point: dict, painter: Painter, seed: int, pool: ThreadPoolExecutor) -> dict:
    """Look at one marker from every distance and tilt.

    Each camera turns about its axis and looks a little past the marker, by seeded amounts that are the same
    for every method, so that modules fall anywhere on the pixels.

    Returns `views`: distance_m, tilt_deg, and position_mm, angle_deg, corners_px (root mean square), all None
    where the marker was not read.
    """
    category = CATEGORIES[point["category"]]
    name = f"{category.name}-{point['index']}"
    spec = category.spec(point["index"], seed)
    plain = plain_marker(spec)
    draw = painter.open(point["method"], name, spec, SIZE / plain.bits.shape[1])
    waiting = []
    for distance in point["distances"]:
        for tilt in point["tilts"]:
            camera = camera_at(distance, tilt, f"{seed} pose {name} {distance} {tilt}")
            errors = pool.submit(_errors, plain, camera, draw(camera))
            waiting.append(({"distance_m": distance, "tilt_deg": tilt}, errors))
    return {"views": [place | interrupts.result_of(errors) for place, errors in waiting]}


def _errors(plain: Marker, camera: Camera, picture: np.ndarray) -> dict[str, float | None]:
    code = own_code(plain, picture)
    if code is None:
        return {"position_mm": None, "angle_deg": None, "corners_px": None}
    away, turn = pose_error(marker_pose(code.corners, SIZE, camera), camera.world_to_camera)
    off = corner_error(code, camera.project(plain.corners * (SIZE / plain.size)))
    return {"position_mm": away * 1e3, "angle_deg": math.degrees(turn), "corners_px": off}


def camera_at(distance: float, tilt: float, seed: str) -> Camera:
    """A camera ``distance`` metres from the origin, ``tilt`` degrees off the marker's normal at a random
    azimuth, turned by up to 20 degrees, looking up to 3 degrees past the marker."""
    generator = random.Random(seed)
    a, b = math.radians(tilt), generator.uniform(0, 2 * math.pi)
    towards = np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), -math.cos(a)])
    turn = math.radians(generator.uniform(-20, 20))
    past = distance * math.tan(math.radians(3.0))
    aim = [generator.uniform(-past, past), generator.uniform(-past, past), 0.0]
    up = (math.sin(turn), -math.cos(turn), 0.0)
    return Camera.look_at(WIDTH, HEIGHT, math.radians(FOV), distance * towards, aim, up)
