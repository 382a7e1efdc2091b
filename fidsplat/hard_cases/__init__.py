"""The catalogue of what can go wrong in splat rendering, as cases that tests and `fidsplat check` run on a
device.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fidsplat.hard_cases.case import Case

GROUPS = {
    "A": "bounds, near plane",
    "B": "homography",
    "C": "order, ties",
    "D": "alpha, depth",
    "E": "inputs, sizes",
    "F": "arithmetic",
}
"""Letter of each group of the catalogue -> what it is about."""


def all_cases(groups: str = "ABCDEF") -> tuple[Case, ...]:
    """Every case of the groups named by their letters, in the catalogue's order."""
    modules = (importlib.import_module(f"fidsplat.hard_cases.group_{letter.lower()}") for letter in groups)
    return tuple(case for module in modules for case in module.CASES)
