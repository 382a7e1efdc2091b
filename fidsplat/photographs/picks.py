"""Scale of a capture from the distance of two points, which are picked as pixels of photographs."""

from __future__ import annotations

import numpy as np

from fidsplat.photographs.mapping import Model
from fidsplat.photographs.photos import name_key
from fidsplat.util.errors import InputError, unknown

SNAP = 0.02
"""largest distance of a picked pixel from a feature, as a fraction of the image's width"""
NEIGHBOURS, MIN_NEIGHBOURS = 16, 6
"""features around a picked pixel that determine its depth, and their minimum number"""

Pick = tuple[str, float, float]
"""a photograph, and x and y in pixels"""


def parse_scale(text: str) -> tuple[Pick, Pick, float]:
    """Two picks and their distance in metres, from `NAME:X:Y,NAME:X:Y=METRES`. Raises InputError."""
    points, _, metres = text.rpartition("=")
    try:
        first, second = (
            (name, float(x), float(y)) for name, x, y in (point.rsplit(":", 2) for point in points.split(","))
        )
        length = float(metres)
        if not (0 < length < np.inf and np.isfinite([*first[1:], *second[1:]]).all()):
            raise ValueError
    except ValueError:
        raise InputError(
            f"--scale must be two pixels of photographs and their distance in metres, got {text!r}; write "
            "for example a.jpg:812:430,b.jpg:120:655=1.25"
        ) from None
    if first == second:
        raise InputError(
            f"--scale must be two different points, got {points}; pick corners far from each other"
        )
    return first, second, length


def scale_of(model: Model, first: Pick, second: Pick, metres: float) -> tuple[float, float]:
    """Metres per unit of the model, and its relative standard error, from the distance of two points.

    first, second: pixels of photographs, between features of the points' surfaces.

    Raises InputError for an unknown photograph, or a pixel without features nearby.
    """
    (a, a_error), (b, b_error) = _picked(model, first), _picked(model, second)
    distance = float(np.linalg.norm(b - a))
    if not distance > 0:
        raise InputError("--scale must be two different points, got one; pick corners far from each other")
    along = (b - a) / distance
    return metres / distance, float(np.hypot(along @ a_error, along @ b_error)) / distance


def _picked(model: Model, pick: Pick) -> tuple[np.ndarray, np.ndarray]:
    """Point (3,) at a pixel in the plane of the features around it, and its standard error (3,) along the
    ray.

    In a plane the inverse depth is linear in the normalised image coordinates; weights are robust, and
    smaller for remote features.
    """
    name, x, y = pick
    keys = [name_key(each) for each in model.names]
    if name_key(name) not in keys:
        raise InputError(unknown("photograph with a camera, of --scale,", name, model.names))
    number = keys.index(name_key(name))
    camera, pixels = model.cameras[number], model.pixels[number]
    distances = np.hypot(*(pixels - (x, y)).T)
    near = np.argsort(distances, kind="stable")[:NEIGHBOURS]
    if len(near) < MIN_NEIGHBOURS or distances[near[0]] > SNAP * camera.width:
        nearest = "none" if not len(near) else "the nearest at {:.0f}:{:.0f}".format(*pixels[near[0]])
        raise InputError(
            f"--scale must have pixels among features, got {name}:{x:g}:{y:g} with {nearest}; pick a pixel "
            "of a textured surface"
        )
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    points = model.points[model.tracks[number][near]] @ rotation.T + shift
    inverse = 1 / points[:, 2]
    ray = camera.rays(np.array([[x, y]]))[0]
    ray = ray / ray[2]
    offsets = points[:, :2] * inverse[:, None] - ray[:2]
    squares = (offsets**2).sum(1)
    closeness = 1 / (1 + squares / max(float(np.median(squares)), 1e-12))
    columns, weights = np.c_[np.ones(len(near)), offsets], closeness
    for _ in range(15):
        matrix = (columns * weights[:, None]).T @ columns
        plane = np.linalg.lstsq(matrix, (columns * weights[:, None]).T @ inverse, rcond=1e-9)[0]
        residuals = np.abs(inverse - columns @ plane)
        noise = max(1.4826 * float(np.median(residuals)), 1e-9 * float(inverse.mean()))
        weights = closeness / np.maximum(1, residuals / (1.5 * noise))
    depth = 1 / plane[0]
    error = noise * float(np.sqrt(np.linalg.pinv(matrix)[0, 0])) * depth**2
    return (depth * ray - shift) @ rotation, (error * ray) @ rotation
