"""STag markers (Benligiray, Topal and Akinlar 2019): 48 code circles within a white disk on a dark square.

`stag.npz` holds the codes of the authors' marker generator, github.com/bbenligiray/stag (Copyright (c) 2019
Burak Benligiray; MIT), packed into bytes, in which 1 is dark.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from fidsplat.images import __file__ as _images
from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import DeviceError, InputError

EDGE = 16
"""modules along an edge"""
_DISK, _CODE, _FILLER = 0.4, 0.7 * 0.062482177287080, 0.7 * 0.7 * 0.062482177287080
"""radii of the white disk, a code circle, and a circle between neighbours, relative to the edge"""
_NEAR = 0.7 * 4 * 0.062482177287080
"""distance, relative to the edge, below which dark code circles are joined"""
_SMOOTHED = 0.015
"""radius of the smoothing of the outline between code circles, relative to the edge"""
_CORRECTED = 2
"""bits that the detector corrects, so that no code is read as a code of another library; but hd17:78 and
hd19:23 are the same code"""
# radius relative to 0.7 edges, and angle, of the 12 code circles of a quadrant
_POLAR = (
    (0.088363142525988, np.pi / 4),
    *((0.206935928182607, at) for at in (0.459275804122858, np.pi / 2 - 0.459275804122858)),
    (0.313672146827381, 0.200579720495241),
    *((0.327493143484516, at) for at in (0.591687617505840, np.pi / 2 - 0.591687617505840)),
    (0.313672146827381, np.pi / 2 - 0.200579720495241),
    (0.437421957035861, 0.145724938287167),
    (0.437226762361658, 0.433363129825345),
    (0.430628029742607, np.pi / 4),
    (0.437226762361658, np.pi / 2 - 0.433363129825345),
    (0.437421957035861, np.pi / 2 - 0.145724938287167),
)


@cache
def codes() -> dict[str, np.ndarray]:
    """Codes of each library, hd13 to hd23, (n, 48) uint8, 1 = dark."""
    with np.load(Path(_images).with_name("stag.npz")) as tables:
        return {name: np.unpackbits(tables[name], axis=1) for name in tables.files}


def _parse(text: str, head: str, rest: str) -> Spec:
    library, _, number = rest.lower().partition(":")
    if library not in codes() or not re.fullmatch("[0-9]{1,9}", number):
        raise InputError(
            f"an STag must be stag:LIBRARY:ID with the library {', '.join(codes())}, got {text!r}; "
            "write for example stag:hd21:3"
        )
    if int(number) >= len(codes()[library]):
        raise InputError(f"stag:{library} ids must be 0 to {len(codes()[library]) - 1}, got {number}")
    return Spec(text=text, kind="stag", family=library, id=int(number))


def _bits(spec: Spec) -> tuple[Spec, np.ndarray]:
    import shapely

    from fidsplat.markers.shapes import modules, visible  # here, since it imports shapely

    radius, angle = np.array(_POLAR).T
    angle = (angle + np.pi / 2 * np.arange(4)[:, None]).ravel()
    points = 0.5 + 0.7 * np.tile(radius, 4)[:, None] * np.column_stack([np.cos(angle), -np.sin(angle)])
    dark = codes()[spec.family or ""][spec.id or 0] == 1
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    one, other = np.nonzero(np.triu(distances < _NEAR, 1) & dark[:, None] & dark)

    def circles(centers: np.ndarray, radius: float) -> shapely.Geometry:
        sides = 4 if radius < _DISK else 16  # of a quadrant: 1/1000 of the edge from the circle
        return shapely.union_all(
            shapely.buffer(shapely.points(EDGE * centers), EDGE * radius, quad_segs=sides)
        )

    light, code = circles(points[~dark], _CODE), circles(points[dark], _CODE)
    pattern = shapely.union(code, circles((points[one] + points[other]) / 2, _FILLER))
    pattern = shapely.difference(pattern, light)
    for step in (-1, 2, -1):  # opening and closing, as the authors' generator: no slivers between circles
        pattern = shapely.buffer(pattern, step * EDGE * _SMOOTHED, quad_segs=2)
    square, disk = shapely.box(0, 0, EDGE, EDGE), circles(np.array([[0.5, 0.5]]), _DISK)
    painted: list[tuple[shapely.Geometry, int]] = [
        (shapely.MultiPolygon(list(shapely.get_parts(shape))), value)
        for shape, value in ((square, 1), (disk, 0), (pattern.simplify(0.02), 1), (code, 1), (light, 0))
    ]
    regions = visible(painted, (EDGE, EDGE))
    return replace(spec, regions=regions), modules(regions, (EDGE, EDGE))


def _detect(grey: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    try:
        from stag import detectMarkers  # type: ignore[import-not-found]
    except ImportError as error:
        raise DeviceError(
            "stag-python must be installed to detect STags, got none; pip install stag-python"
        ) from error
    for library in codes():
        corners, ids, _ = detectMarkers(grey, int(library[2:]), errorCorrection=_CORRECTED)
        for number, quad in zip(np.ravel(ids), corners, strict=True):
            yield f"stag:{library}:{number}", np.reshape(quad, (4, 2)) + 0.5


KINDS = (Kind("stag", "stag:LIBRARY:ID", 2, _parse, _bits, detect=_detect, default=False),)
