"""Every case, by the letters of the groups."""

from __future__ import annotations

from fidsplat.selftest import (  # noqa: F401  each enters its cases
    alpha,
    arithmetic,
    bounds,
    ellipsoids,
    homography,
    inputs,
    order,
)
from fidsplat.selftest.case import CASES, Case

GROUPS = {
    "A": "bounds, near plane",
    "B": "homography",
    "C": "order, ties",
    "D": "alpha, depth",
    "E": "inputs, sizes",
    "F": "arithmetic",
    "G": "3D Gaussians",
}
"""Letter of each group of the catalogue -> what it is about."""


def all_cases(groups: str = "ABCDEFG") -> tuple[Case, ...]:
    """Every case of the groups named by their letters, in the catalogue's order."""
    return tuple(sorted((case for case in CASES if case.name[0] in groups), key=lambda case: case.name))
