"""Catalogue of all hard cases by group."""

from __future__ import annotations

from fidsplat.selftest import (  # noqa: F401  registers its cases
    alpha,
    arithmetic,
    bounds,
    ellipsoids,
    inputs,
    intersection,
    order,
)
from fidsplat.selftest.case import CASES, Case

GROUPS = {
    "A": "bounds, near plane",
    "B": "intersection",
    "C": "order, ties",
    "D": "alpha, depth",
    "E": "inputs, sizes",
    "F": "arithmetic",
    "G": "3D Gaussians",
}
"""letter of each group -> topic"""


def all_cases(groups: str = "ABCDEFG") -> tuple[Case, ...]:
    """Cases of the groups with these letters, sorted by name."""
    return tuple(sorted((case for case in CASES if case.name[0] in groups), key=lambda case: case.name))
