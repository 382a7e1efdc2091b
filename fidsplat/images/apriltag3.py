"""Tags of AprilTag 3 with data bits outside of the border: layouts and codes of AprilRobotics.

`apriltag3.npz` contains the tables of github.com/AprilRobotics/apriltag (Copyright (C) 2013-2016, The Regents
of The University of Michigan; BSD 2-Clause), written by `tools/apriltag3_tables.py`. Codes are stored as
increments: each code is the previous code plus a multiple of `STEP`.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

TABLES = Path(__file__).with_name("apriltag3.npz")
STEP = 982451653
HOLE = 255
"""value of missing modules: the corners of round tags, and the centre of recursive tags"""


class Layout(NamedTuple):
    """Size in modules of the tags of a family."""

    size: int
    """edge of the tag, including outer data bits"""
    border: int
    """edge of the border, which detectors report; `size` of a marker is the length of this edge"""


LAYOUTS = {
    "standard41h12": Layout(9, 5),
    "standard52h13": Layout(10, 6),
    "circle21h7": Layout(9, 5),
    "circle49h12": Layout(11, 5),
    "custom48h12": Layout(10, 6),
}


def outside(family: str | None) -> int:
    """Modules outside of a tag's border on each side; 0 for families of other libraries."""
    layout = LAYOUTS.get(family or "")
    return (layout.size - layout.border) // 2 if layout else 0


@cache
def codes(family: str) -> np.ndarray:
    """Codes of a family, (n,) uint64; the first data bit is the most significant bit."""
    with np.load(TABLES) as tables:
        steps = np.ascontiguousarray(tables[f"{family}_steps"].T).view("<u8")[:, 0]
        bits = tables[f"{family}_xy"].shape[1]
    return np.cumsum(steps.astype(np.uint64) * np.uint64(STEP)) & np.uint64((1 << bits) - 1)


def tag_bits(family: str, tag_id: int) -> np.ndarray:
    """Modules of a tag, (size, size) uint8, 1 = dark; `HOLE` for missing modules."""
    size, ring = LAYOUTS[family].size, outside(family)
    with np.load(TABLES) as tables:
        x, y = tables[f"{family}_xy"].astype(int) + ring
    bits = np.full((size, size), HOLE, np.uint8)
    # a dark ring around a light ring; data bits inside and outside
    for inset, value in ((ring - 1, 1), (ring, 0), (ring + 1, HOLE)):
        bits[inset : size - inset, inset : size - inset] = value
    shifts = np.arange(len(x), dtype=np.uint64)[::-1]
    bits[y, x] = 1 - (codes(family)[tag_id] >> shifts & np.uint64(1))
    return bits
