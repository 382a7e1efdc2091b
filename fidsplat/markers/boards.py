"""Boards of tags of OpenCV and Kalibr: ChArUco, grid boards and AprilGrids.

All lengths are whole modules, so that boards are partitioned into rectangles like other markers. Ids start at
0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from fidsplat.images.family_names import canonical_family
from fidsplat.markers.spec import Kind, Spec
from fidsplat.util.errors import InputError

GAP = 2
"""Modules between the tags of a grid, and between the edges of squares and tags of ChArUco in total."""

MAX_TAGS = 64
"""Maximum number of tags or squares along an edge."""


@dataclass(frozen=True, kw_only=True)
class BoardSpec(Spec):
    """Spec of a board of markers: its columns and rows."""

    columns: int
    rows: int


def _parse(text: str, head: str, rest: str) -> BoardSpec:
    kind = head.lower()
    match = re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4}):(.+)", rest)
    if not match:
        raise InputError(
            f"a board must be COLUMNSxROWS:FAMILY, got {text!r}; for example {kind}:{_EXAMPLES[kind]}"
        )
    columns, rows = int(match[1]), int(match[2])
    smallest = 2 if kind == "charuco" else 1
    if not (smallest <= columns <= MAX_TAGS and smallest <= rows <= MAX_TAGS):
        raise InputError(f"a board must have {smallest} to {MAX_TAGS} columns and rows, got {text!r}")
    return BoardSpec(text=text, kind=kind, family=canonical_family(match[3]), columns=columns, rows=rows)


def tag_positions(spec: BoardSpec, side: int) -> list[tuple[int, int]]:
    """Positions of the tags of a board by id: row and column, in modules, of the top left corner. side: edge
    of a tag in modules.

    ChArUco: in the white squares, row by row. Grids: row by row from the top left, AprilGrids from the bottom
    left, with a corner square around them.
    """
    cells = [(y, x) for y in range(spec.rows) for x in range(spec.columns)]
    step = side + GAP
    if spec.kind == "charuco":
        return [(step * y + GAP // 2, step * x + GAP // 2) for y, x in cells if (x + y) % 2]
    if spec.kind == "aprilgrid":
        return [(step * (spec.rows - 1 - y) + GAP, step * x + GAP) for y, x in cells]
    return [(step * y, step * x) for y, x in cells]


def _bits(spec: BoardSpec) -> tuple[Spec, np.ndarray]:
    """Modules of a board: tags, and for ChArUco a chessboard whose top left square is dark, for AprilGrids
    corner squares."""
    from fidsplat.images.tag_dictionaries import dictionary_bits, families, parse_family, predefined

    kind, family = parse_family(spec.family or "")
    if kind != "apriltag" and spec.kind == "aprilgrid":
        raise InputError(
            f"the family of an AprilGrid must be AprilTags, got {spec.text!r}; e.g. {_EXAMPLES['aprilgrid']}"
        )
    predefined(kind, family)  # refuses families that board detectors lack
    side, known = families(kind)[family]
    places, step = tag_positions(spec, side), side + GAP
    if len(places) > known:
        raise InputError(
            f"a board of {family} must have at most {known} tags, got {len(places)} for {spec.text!r}; use a "
            "smaller board"
        )
    beyond = {"charuco": 0, "gridboard": -GAP, "aprilgrid": GAP}[spec.kind]
    y, x = np.indices((spec.rows * step + beyond, spec.columns * step + beyond))
    bits = np.zeros(y.shape, np.uint8)
    if spec.kind == "charuco":
        bits[(y // step + x // step) % 2 == 0] = 1
    elif spec.kind == "aprilgrid":
        bits[(y % step < GAP) & (x % step < GAP)] = 1
    for number, (row, column) in enumerate(places):
        bits[row : row + side, column : column + side] = dictionary_bits(kind, family, number)
    return spec, bits


_EXAMPLES = {"charuco": "7x5:4x4_50", "gridboard": "5x7:4x4_50", "aprilgrid": "6x6:36h11"}
KINDS = tuple(Kind(name, f"{name}:CxR:FAMILY", GAP, _parse, _bits) for name in _EXAMPLES)
