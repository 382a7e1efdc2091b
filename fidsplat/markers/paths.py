"""Outlines of SVG shapes as closed rings of points."""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np

Rings = list[np.ndarray]
"""closed outlines, each (n, 2) float64 x, y, the last point joined to the first"""

PIECES = 64
"""Number of straight pieces of a curve."""

FARTHEST = 1e9
"""Maximum magnitude of a number in a drawing."""

_TOKEN = re.compile(r"([MmLlHhVvCcSsQqTtAaZz])|([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)")
_BETWEEN = re.compile(r"[\s,]*")
_FLAG = re.compile(
    r"()([01])"
)  # flag of an arc: a single digit, optionally without a separator to the next number
_NUMBERS = {"M": 2, "L": 2, "H": 1, "V": 1, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7, "Z": 0}


def number(text: str) -> float:
    """Parse a number of a drawing, in pixels. Raises ValueError for another text, or beyond `FARTHEST`."""
    value = float(text.removesuffix("px"))
    if not abs(value) <= FARTHEST:
        raise ValueError(f"a number must be at most {FARTHEST:g}, got {text[:20]}")
    return value


def polygon_rings(points: str) -> Rings:
    """Ring of a polygon's `points`. Raises ValueError for an odd number of coordinates."""
    numbers = [number(text) for _, text in _TOKEN.findall(points)]
    if len(numbers) % 2:
        raise ValueError("coordinates must be pairs, got an odd number")
    return [np.array(numbers).reshape(-1, 2)] if len(numbers) >= 6 else []


def circle_rings(cx: float, cy: float, rx: float, ry: float) -> Rings:
    """Ring of an ellipse."""
    angle = np.linspace(0, 2 * np.pi, 4 * PIECES, endpoint=False)
    return [np.column_stack([cx + rx * np.cos(angle), cy + ry * np.sin(angle)])]


def rectangle_rings(x: float, y: float, w: float, h: float, rx: float, ry: float) -> Rings:
    """Ring of a rectangle with rounded corners."""
    if not (w > 0 and h > 0):
        return []
    rx, ry = min(rx, w / 2), min(ry, h / 2)
    if not (rx > 0 and ry > 0):
        return [np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])]
    angle = np.linspace(0, np.pi / 2, PIECES + 1)
    centers = ((x + w - rx, y + h - ry), (x + rx, y + h - ry), (x + rx, y + ry), (x + w - rx, y + ry))
    corners = [
        np.column_stack([cx + rx * np.cos(angle + i * np.pi / 2), cy + ry * np.sin(angle + i * np.pi / 2)])
        for i, (cx, cy) in enumerate(centers)
    ]
    return [np.concatenate(corners)]


def path_rings(text: str) -> Rings:
    """Rings of a path's `d`: closed subpaths, with curves as polylines.

    Raises ValueError for a command with too few numbers, or a path that does not begin with a move.
    """
    rings: Rings = []
    points: list[np.ndarray] = []
    here, control, before = np.zeros(2), np.zeros(2), ""
    for command, v in _commands(text):
        kind, base = command.upper(), here if command.islower() else np.zeros(2)
        if not before and kind != "M":
            raise ValueError(f"a path must begin with M, got {command}")
        if kind in "MZ":
            if len(points) > 2:
                rings.append(np.array(points))
            start = v + base if kind == "M" else points[0] if points else here
            points, here = [start], start
        elif kind == "A":
            end = v[5:] + base
            points += _arc(here, end, abs(v[0]), abs(v[1]), np.radians(v[2]), bool(v[3]), bool(v[4]))
            here = end
        elif kind in "LHV":
            end = here.copy()
            if kind == "L":
                end = v + base
            else:
                axis = "HV".index(kind)
                end[axis] = v[0] + base[axis]
            points.append(end)
            here = end
        else:
            vertices = v.reshape(-1, 2) + base
            if kind in "ST":  # reflection of the previous control point
                smooth = before in ("CS" if kind == "S" else "QT")
                vertices = np.vstack([2 * here - control if smooth else here, vertices])
            curve = np.vstack([here, vertices])
            points += list(_bezier(curve))
            control, here = curve[-2], curve[-1]
        before = kind
    return [*rings, np.array(points)] if len(points) > 2 else rings


def _commands(text: str) -> Iterator[tuple[str, np.ndarray]]:
    """Commands of an SVG path with their arguments; pairs after the first one of a move are lines."""
    command, numbers = "", []
    place = _skip(text, 0)
    while place <= len(text):
        in_flag = command in ("A", "a") and len(numbers) % 7 in (3, 4)
        match = (_FLAG if in_flag else _TOKEN).match(text, place)
        if match is None and place < len(text):
            raise ValueError(
                f"a path must have commands and numbers, got {text[place : place + 10].split()[0]!r}"
            )
        letter, digits = ("Z", "") if match is None else match.groups(default="")
        place = len(text) + 1 if match is None else _skip(text, match.end())
        if not letter:
            numbers.append(number(digits))
            continue
        if command:
            size = _NUMBERS[command.upper()]
            if (len(numbers) % size if size else numbers) or (size and not numbers):
                expected = f"a multiple of {size}" if size else "0"
                raise ValueError(f"{command} must have {expected} numbers, got {len(numbers)}")
            if not size:
                yield command, np.zeros(0)
            for i in range(0, len(numbers), size or 1):
                yield command, np.array(numbers[i : i + size])
                command = "L" if command == "M" else "l" if command == "m" else command
        elif numbers:
            raise ValueError(f"a path must begin with M, got {numbers[0]:g}")
        command, numbers = letter, []


def _skip(text: str, place: int) -> int:
    """Position of the next number or letter."""
    between = _BETWEEN.match(text, place)
    return place if between is None else between.end()


def _bezier(control: np.ndarray) -> np.ndarray:
    """Points (PIECES, 2) along a curve of 3 or 4 control points, without its start."""
    t = np.linspace(0, 1, PIECES + 1)[1:, None, None]
    points = np.repeat(control[None], PIECES, 0)
    while points.shape[1] > 1:
        points = points[:, :-1] * (1 - t) + points[:, 1:] * t
    return points[:, 0]


def _arc(
    start: np.ndarray, end: np.ndarray, rx: float, ry: float, rotation: float, large: bool, sweep: bool
) -> list[np.ndarray]:
    """Points along an elliptical arc, without its start (SVG 1.1, appendix F.6)."""
    if not (rx and ry) or np.array_equal(start, end):
        return [end]
    to_axes = np.array([[np.cos(rotation), np.sin(rotation)], [-np.sin(rotation), np.cos(rotation)]])
    half = to_axes @ (start - end) / 2
    grown = max(1.0, np.sqrt((half[0] / rx) ** 2 + (half[1] / ry) ** 2))
    radii = np.array([rx, ry]) * grown
    x, y = half / radii
    aside = np.sqrt(max(1 / (x * x + y * y) - 1, 0.0)) * (-1 if large == sweep else 1)
    middle = aside * np.array([y, -x])
    first, last = (np.arctan2(*(way * np.array([x, y]) - middle)[::-1]) for way in (1, -1))
    span = (last - first) % (2 * np.pi) - (0 if sweep else 2 * np.pi)
    angles = first + span * np.linspace(0, 1, PIECES + 1)[1:]
    circle = np.column_stack([np.cos(angles), np.sin(angles)]) + middle
    return list((circle * radii) @ to_axes + (start + end) / 2)
