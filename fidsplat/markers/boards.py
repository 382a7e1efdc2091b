"""Boards of tags, as OpenCV's board detectors and Kalibr know them: ChArUco, grid boards and AprilGrids.

All are made of whole modules, so that they are cut into rectangles like any other marker. Ids count from 0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from fidsplat.errors import InputError
from fidsplat.markers.spec import Kind, Spec

GAP = 2
"""Modules between the tags of a grid, and by which a ChArUco board's squares are larger than its tags."""

MAX_TAGS = 64
"""Most tags or squares along an edge."""


@dataclass(frozen=True, kw_only=True)
class BoardSpec(Spec):
    """A board's spec."""

    columns: int
    rows: int


def _parse(text: str, head: str, rest: str) -> BoardSpec:
    kind = head.lower()
    found = re.fullmatch(r"([0-9]{1,4})[xX]([0-9]{1,4}):(.+)", rest)
    if not found:
        raise InputError(f"{text!r} is not COLUMNSxROWS:FAMILY; write for example {kind}:{_EXAMPLES[kind]}")
    columns, rows = int(found[1]), int(found[2])
    least = 2 if kind == "charuco" else 1
    if not (least <= columns <= MAX_TAGS and least <= rows <= MAX_TAGS):
        raise InputError(f"{text!r}: columns and rows must lie from {least} to {MAX_TAGS}")
    return BoardSpec(text=text, kind=kind, family=found[3].lower(), columns=columns, rows=rows)


def _tags(spec: BoardSpec, count: int) -> list[np.ndarray]:
    """The first tags of the board's family."""
    from fidsplat.vision.dictionaries import dictionary_bits, families, parse_family

    kind, family = parse_family(spec.family or "")
    if kind != "apriltag" and spec.kind == "aprilgrid":
        raise InputError(f"{spec.text!r}: an AprilGrid has AprilTags, e.g. {_EXAMPLES['aprilgrid']}")
    known = families(kind)[family].count
    if count > known:
        raise InputError(f"{spec.text!r} needs {count} tags, but {family} has {known}: take a smaller board")
    return [dictionary_bits(kind, family, number) for number in range(count)]


def _charuco(spec: BoardSpec) -> tuple[Spec, np.ndarray]:
    """Squares in turn dark and white, the top left one dark, tags in the white ones row by row."""
    white = [(y, x) for y in range(spec.rows) for x in range(spec.columns) if (x + y) % 2]
    tags = _tags(spec, len(white))
    square = len(tags[0]) + GAP
    bits = np.kron(1 - np.indices((spec.rows, spec.columns)).sum(0) % 2, np.ones((square, square), int))
    for (y, x), tag in zip(white, tags, strict=True):
        _put(bits, tag, square * y + GAP // 2, square * x + GAP // 2)
    return spec, bits.astype(np.uint8)


def _grid(spec: BoardSpec) -> tuple[Spec, np.ndarray]:
    """Tags row by row from the top left, apart by the gap."""
    tags = _tags(spec, spec.columns * spec.rows)
    step = len(tags[0]) + GAP
    bits = np.zeros((spec.rows * step - GAP, spec.columns * step - GAP), np.uint8)
    for number, tag in enumerate(tags):
        y, x = divmod(number, spec.columns)
        _put(bits, tag, step * y, step * x)
    return spec, bits


def _april_grid(spec: BoardSpec) -> tuple[Spec, np.ndarray]:
    """Tags row by row from the bottom left, a dark square of the gap's size at each of their corners."""
    tags = _tags(spec, spec.columns * spec.rows)
    step = len(tags[0]) + GAP
    bits = np.zeros((spec.rows * step + GAP, spec.columns * step + GAP), np.uint8)
    for y in range(GAP):
        for x in range(GAP):
            bits[y::step, x::step] = 1
    for number, tag in enumerate(tags):
        y, x = divmod(number, spec.columns)
        _put(bits, tag, step * (spec.rows - 1 - y) + GAP, step * x + GAP)
    return spec, bits


def _put(bits: np.ndarray, tag: np.ndarray, y: int, x: int) -> None:
    bits[y : y + len(tag), x : x + len(tag)] = tag


_EXAMPLES = {"charuco": "7x5:4x4_50", "gridboard": "5x7:4x4_50", "aprilgrid": "6x6:36h11"}
_MAKERS = {"charuco": _charuco, "gridboard": _grid, "aprilgrid": _april_grid}
KINDS = tuple(Kind(name, f"{name}:CxR:FAMILY", GAP, _parse, _MAKERS[name]) for name in _EXAMPLES)
