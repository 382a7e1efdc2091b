"""Entry points of installed packages: `fidsplat.markers`, `fidsplat.outputs`, `fidsplat.effects`."""

import warnings
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import Any


@cache
def load_plugins(group: str, register: Callable[[Any], None]) -> None:
    """Register the objects of a group's entry points, once per process; warn about plugins that fail."""
    for entry in entry_points(group=group):
        try:
            register(entry.load())
        except Exception as error:
            package = entry.dist.name if entry.dist else entry.value
            warnings.warn(
                f"{group}: {entry.name} of {package} must load and register, got {error!r}; update or "
                "uninstall the package",
                stacklevel=2,
            )
