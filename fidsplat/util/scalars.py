"""Numbers and arrays of numbers as users give them."""

from dataclasses import fields
from typing import Any

import numpy as np

from fidsplat.util.errors import InputError

LARGEST = 1e15
"""metres, or units of colour: with anything larger, products of single precision would overflow on devices"""


class PickledByFields:
    """Base of frozen dataclasses that are pickled and copied by their fields, without what they keep for
    later, and whose arrays are read-only again afterwards."""

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}  # type: ignore[arg-type]

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)


def own_scalars(data: Any) -> None:
    """NumPy's scalars among the fields of a dataclass, frozen or not, become Python's own numbers."""
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.generic):
            object.__setattr__(data, field.name, value.item())


def real_array(name: str, value: Any, wanted: str = "an array of real numbers") -> np.ndarray:
    """Real numbers, of any shape, as float64. Raises InputError for anything else, with the name and what is
    wanted."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # rows that differ in length, say
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        raise InputError(f"{name} must be {wanted}, not {value!r}")
    return array.astype(np.float64)
