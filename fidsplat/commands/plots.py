"""--plot of the commands that measure: a chart of what was found."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from fidsplat.commands.output import writable_file
from fidsplat.errors import InputError


def check_plot(name: str, packages: Sequence[str] = ("matplotlib",)) -> None:
    """Raises InputError for a chart that cannot be written, before anything is measured; packages: what
    draws it."""
    if Path(name).suffix.lower() not in (".svg", ".png"):
        raise InputError(f"--plot is {name}; charts are written as SVG or PNG: name a file that ends so")
    missing = [package for package in packages if find_spec(package) is None]
    if missing:
        raise InputError(f"--plot needs {' and '.join(missing)}; pip install 'fidsplat[experiments]'")
    writable_file(name)
