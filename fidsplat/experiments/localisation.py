"""Localisation accuracy: pose errors of one marker by distance and tilt."""

from __future__ import annotations

import math
import random
from concurrent.futures import Executor

import numpy as np

from fidsplat.cameras import Camera
from fidsplat.experiments.methods import MarkerRenderer
from fidsplat.experiments.setup import CATEGORIES
from fidsplat.markers import Marker, marker
from fidsplat.util import interrupts
from fidsplat.vision.pose import marker_pose, pose_error
from fidsplat.vision.readback import corner_error, detect_marker

NAME = "localisation"
LOCATED = ("apriltag", "small")
SIZE = 0.16
"""edge of the code in metres"""
WIDTH, HEIGHT, FOV = 1280, 720, 60.0
FULL = (0.5, 1.0, 2.0, 3.0, 4.0), (0.0, 20.0, 40.0, 60.0, 70.0)
"""distances in metres and tilts in degrees"""
QUICK = (0.5, 1.0, 2.0), (0.0, 40.0, 60.0)


def measure_localisation(point: dict, markers: MarkerRenderer, seed: int, pool: Executor) -> dict:
    """Pose errors of a marker at every distance and tilt.

    Roll and aim of the cameras are random, so that modules are not aligned with pixels, and the same for all
    methods.

    Returns `views`: distance_m, tilt_deg, position_mm, angle_deg, corners_px (RMS); the errors are None if
    the marker was not read.
    """
    category = CATEGORIES[point["category"]]
    name = f"{category.name}-{point['index']}"
    spec = category.spec(point["index"], seed)
    plain = marker(spec)
    render = markers.prepare(point["method"], name, spec, SIZE / plain.bits.shape[1])
    pending = []
    for distance in point["distances"]:
        for tilt in point["tilts"]:
            camera = camera_at(distance, tilt, f"{seed} pose {name} {distance} {tilt}")
            errors = pool.submit(_errors, plain, camera, render(camera))
            pending.append(({"distance_m": distance, "tilt_deg": tilt}, errors))
    return {"views": [view | interrupts.result_of(errors) for view, errors in pending]}


def _errors(plain: Marker, camera: Camera, image: np.ndarray) -> dict[str, float | None]:
    code = detect_marker(plain, image)
    if code is None:
        return {"position_mm": None, "angle_deg": None, "corners_px": None}
    metres, radians = pose_error(marker_pose(code.corners, SIZE, camera), camera.world_to_camera)
    pixels = corner_error(code, camera.project(plain.corners * (SIZE / plain.size)))
    return {"position_mm": metres * 1e3, "angle_deg": math.degrees(radians), "corners_px": pixels}


def camera_at(distance: float, tilt: float, seed: str) -> Camera:
    """Camera at a distance in metres and a tilt in degrees from the marker's normal.

    Azimuth, a roll of up to 20 degrees, and an aim of up to 3 degrees off the marker are random.
    """
    generator = random.Random(seed)
    a, b = math.radians(tilt), generator.uniform(0, 2 * math.pi)
    direction = np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), -math.cos(a)])
    roll = math.radians(generator.uniform(-20, 20))
    max_offset = distance * math.tan(math.radians(3.0))
    aim = [generator.uniform(-max_offset, max_offset), generator.uniform(-max_offset, max_offset), 0.0]
    up = (math.sin(roll), -math.cos(roll), 0.0)
    return Camera.look_at(WIDTH, HEIGHT, math.radians(FOV), distance * direction, aim, up)
