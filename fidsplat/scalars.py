"""Numbers as a scene file says them."""

from dataclasses import fields
from typing import Any

import numpy as np


def own_scalars(data: Any) -> None:
    """NumPy's scalars among the fields of a dataclass, frozen or not, become Python's own numbers."""
    for field in fields(data):
        value = getattr(data, field.name)
        if isinstance(value, np.generic):
            object.__setattr__(data, field.name, value.item())
