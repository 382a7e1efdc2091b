"""What levels of detail were measured to cost: of each low-pass the largest error of pictures by the size on
the picture below which cells are not told apart."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fidsplat.store.layout import header_crc
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, read_input

FILE = "detail.json"
MARGIN = 3.0
"""how many times below the requested error the largest measured one must be: other views exceed the measured
ones, and a few exceed the requested error too"""


@dataclass(frozen=True)
class Detail:
    """Errors by sizes, as they were measured with a store."""

    lowpass: str
    """of the pictures"""
    level: int
    """of the nodes that were drawn, and those below it"""
    sizes: tuple[float, ...]
    """samples, rising: cells that are smaller are not told apart"""
    errors: tuple[float | None, ...]
    """largest difference of rgb from the exact picture over all views, of each size; None where no view had
    cells of about this size"""
    views: int
    device: str
    date: str


def pixels(details: Iterable[Detail], level: int, error: float) -> float:
    """The largest size [samples] at which cells of a level may stand for those below them, so that the
    measured views are off by at most `error` / `MARGIN`; 0: none. Other views may exceed `error`. Sizes that
    no measured view met are not used.

    The level above and the one below count too: cells of a size err alike, but few views meet a level's cells
    where they err most, in the gaps between what they are of.
    """
    near = [one for one in details if abs(one.level - level) <= 1]
    if not any(one.level == level for one in near):
        return 0.0
    met = [pair for one in near for pair in zip(one.sizes, one.errors, strict=True)]
    largest, found = 0.0, 0.0
    for size in sorted({size for size, _ in met}):
        measured = [wrong for at, wrong in met if at == size and wrong is not None]
        if measured:
            largest = max(largest, *measured)
            found = size if largest * MARGIN <= error else found
    return found


def save_details(folder: Path, identity: str, details: Sequence[Detail]) -> None:
    """Write what was measured beside a store; of low-passes that were measured before what is not replaced
    stays."""
    every = [*load_details(folder, identity), *details]
    known = {(one.lowpass, one.level): one for one in every}
    rows = [vars(one) for _, one in sorted(known.items())]
    with atomic_write(folder / FILE) as stream:
        said = {"identity": identity, "details": rows}
        stream.write(json.dumps(said | {"crc": header_crc(said)}, indent=1).encode())


def load_details(folder: Path, identity: str) -> list[Detail]:
    """What was measured with a store; nothing, if it was another one then. Raises InputError for a file that
    is damaged."""
    file = folder / FILE
    if not file.exists():
        return []
    content = read_input(file)
    try:
        said = from_json(content)
        if said["crc"] != header_crc(said):
            raise ValueError
        if said["identity"] != identity:
            return []
        rows = [row | {name: tuple(row[name]) for name in ("sizes", "errors")} for row in said["details"]]
        made = [Detail(**row) for row in rows]
        for one in made:
            if len(one.sizes) != len(one.errors) or list(one.sizes) != sorted(map(float, one.sizes)):
                raise ValueError
            numbers = [*one.sizes, *(error for error in one.errors if error is not None)]
            known = isinstance(one.lowpass, str) and type(one.level) is int
            if not known or not all(type(n) in (int, float) and 0 <= n < math.inf for n in numbers):
                raise ValueError
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{file} is damaged; remove it, and run `fidsplat store measure` again") from None
    return made
