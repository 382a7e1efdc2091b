"""Numbers and arrays of numbers as users give them."""

from dataclasses import fields
from typing import Any

import numpy as np

from fidsplat.errors import InputError

LARGEST = 1e15
"""metres, or units of colour: with anything larger, products of single precision would overflow on devices"""


def own_scalars(data: Any) -> None:
    """NumPy's scalars among the fields of a dataclass, frozen or not, become Python's own numbers."""
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.generic):
            object.__setattr__(data, field.name, value.item())


def real_array(name: str, value: Any) -> np.ndarray:
    """Real numbers, of any shape, as float64. Raises InputError, with the name, for anything else."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # rows that differ in length, say
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        raise InputError(f"{name} must be an array of real numbers, not {value!r}")
    return array.astype(np.float64)
