"""Measured errors of a store's levels of detail, by low-pass filter, level and projected cell size."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fidsplat.capture.quality import LOWPASS
from fidsplat.store.layout import header_crc, write_checked
from fidsplat.util.arguments import Names, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import from_json, read_input

FILE = "detail.json"
MARGIN = 3.0
"""ratio of the requested error to the largest measured error, as other views may have larger errors"""


@dataclass(frozen=True)
class DetailSettings:
    """Views of a measurement of levels of detail. Raises InputError for an unusable value."""

    views: int = 60
    """number of viewpoints; each measures one level, round robin"""
    lowpass: Names = ("pixel",)
    """low-pass filters: pixel, screen, none"""
    seed: int = 0
    """seed of the viewpoints"""

    def __post_init__(self) -> None:
        whole_number("views", self.views, 1, 10_000)
        if unknown := set(self.lowpass) - set(LOWPASS):
            raise InputError(f"lowpass must be one or more of {', '.join(LOWPASS)}, got {min(unknown)!r}")


@dataclass(frozen=True)
class DetailErrors:
    """Measured errors of one level of detail, by cell size."""

    lowpass: str
    """low-pass of the frames"""
    level: int
    """highest level of the rendered nodes"""
    sizes: tuple[float, ...]
    """increasing projected sizes [samples] below which cells are merged"""
    errors: tuple[float | None, ...]
    """largest rgb error over all views, for each size; None if no view had cells of about this size"""
    views: int
    device: str
    date: str


def allowed_cell_size(measured: Iterable[DetailErrors], level: int, error: float) -> float:
    """Largest cell size [samples] of a level with a measured error of at most `error` / `MARGIN`; 0 if there
    is none.

    The errors of adjacent levels count too, as cells of equal size have similar errors: few views contain
    cells of one level at the edges of surfaces, where errors are largest.
    """
    near = [detail for detail in measured if abs(detail.level - level) <= 1]
    if not any(detail.level == level for detail in near):
        return 0.0
    pairs = [pair for detail in near for pair in zip(detail.sizes, detail.errors, strict=True)]
    largest, allowed = 0.0, 0.0
    for size in sorted({size for size, _ in pairs}):
        errors = [own for at, own in pairs if at == size and own is not None]
        if errors:
            largest = max(largest, *errors)
            allowed = size if largest * MARGIN <= error else allowed
    return allowed


def save_detail_errors(folder: Path, identity: str, measured: Sequence[DetailErrors]) -> None:
    """Write measured errors into a store's folder; replace those of the same low-pass filter and level."""
    every = [*load_detail_errors(folder, identity), *measured]
    known = {(detail.lowpass, detail.level): detail for detail in every}
    rows = [vars(detail) for _, detail in sorted(known.items())]
    write_checked(folder / FILE, {"identity": identity, "details": rows})


def load_detail_errors(folder: Path, identity: str) -> list[DetailErrors]:
    """The measured errors of a store; empty if its content has changed since."""
    file = folder / FILE
    if not file.exists():
        return []
    data = read_input(file)
    try:
        content = from_json(data)
        if content["crc"] != header_crc(content):
            raise ValueError
        if content["identity"] != identity:
            return []
        rows = [row | {name: tuple(row[name]) for name in ("sizes", "errors")} for row in content["details"]]
        loaded = [DetailErrors(**row) for row in rows]
        for detail in loaded:
            if len(detail.sizes) != len(detail.errors) or list(detail.sizes) != sorted(
                map(float, detail.sizes)
            ):
                raise ValueError
            numbers = [*detail.sizes, *(error for error in detail.errors if error is not None)]
            known = isinstance(detail.lowpass, str) and type(detail.level) is int
            if not known or not all(type(n) in (int, float) and 0 <= n < math.inf for n in numbers):
                raise ValueError
    except (ValueError, KeyError, TypeError, OverflowError):
        raise InputError(f"{file} is damaged; remove it, and run `fidsplat store measure` again") from None
    return loaded
