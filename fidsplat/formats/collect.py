"""A file's rows made splats, window by window: rows that are no splats are left out on the way, so that
memory follows what is kept and not what the file says it holds."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.splats.arrays import find_defects, with_thinnest_last
from fidsplat.util import interrupts

PADDED_LOG_SCALE = np.log(1e-6)
"""scale_2 of a disk written for tools that want three scales; SuperSplat writes the same"""
WINDOW = 65536
"""rows at a time: less lets the checks cost more than reading"""
BLOCK = 2048
"""rows that are worked on at a time within a window: their records and results stay in a core's cache, so
that walking over them once per property costs no memory traffic"""
_FIRST_ROOM = 1_000_000  # splats; only a file of more rows makes its arrays grow

Progress = Callable[[str, float], Any]
"""called now and then with what is being done and the share of it that is done, 0 to 1"""
_CHECKED = ("means", "quats", "scales", "opacities", "sh", "colors")


@dataclass(frozen=True)
class Rows:
    """Rows of a file, one for each splat, before they are checked."""

    path: Path
    count: int
    columns: dict[str, tuple[tuple[int, ...], type]]
    """shape and type of a splat's part of each array: means, quats, scales (2 or 3), opacities, sh or colors,
    and where the file has them labels and planes"""
    fill: Callable[[int, dict[str, np.ndarray]], None]
    """reads the rows from the given one on into arrays, as many as these have"""

    @property
    def thick(self) -> bool:
        """Whether they have three scales."""
        return self.columns["scales"][0] == (3,)

    @property
    def splat_columns(self) -> dict[str, tuple[tuple[int, ...], type]]:
        """Shape and type of a splat's part of each array of a cloud."""
        thickness: dict[str, tuple[tuple[int, ...], type]] = {"thickness": ((), np.float32)}
        return self.columns | {"scales": ((2,), np.float32)} | (thickness if self.thick else {})


def collect(rows: Rows, progress: Progress | None = None) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """The arrays of the splats that can be drawn, and how many others there are for each reason.

    A third scale becomes `thickness`, which is 0 for a disk: where the third scale is 1e-6, as it is padded
    with, or where one of the three is 0.
    """
    thick, columns = rows.thick, rows.splat_columns
    kept = _Kept(columns, rows.count)
    scratch = np.empty((min(WINDOW, rows.count), 3), np.float32)
    dropped: dict[str, int] = {}
    for first in range(0, rows.count, WINDOW):
        interrupts.check()
        part = kept.room(min(WINDOW, rows.count - first), first)
        good, reasons = _filled(rows, first, part, scratch if thick else None)
        kept.keep(part, good)
        for reason, count in reasons.items():
            dropped[reason] = dropped.get(reason, 0) + count
        if progress is not None:
            progress(f"reading {rows.path.name}", min(1.0, (first + WINDOW) / rows.count))
    return kept.finished(), dropped


def window(rows: Rows, first: int, end: int) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Checked splats of rows [first, end) and the number dropped by reason, for bounded memory."""
    count = end - first
    part = {name: np.empty((count, *shape), kind) for name, (shape, kind) in rows.splat_columns.items()}
    good, dropped = _filled(rows, first, part, np.empty((count, 3), np.float32) if rows.thick else None)
    return part if good is None else {name: array[good] for name, array in part.items()}, dropped


def _filled(
    rows: Rows, first: int, part: dict[str, np.ndarray], scratch: np.ndarray | None
) -> tuple[np.ndarray | None, dict[str, int]]:
    """Reads rows from `first` on into the arrays of splats: which can be drawn, (n,) bool or None for all,
    and how many cannot for each reason. scratch: room for three scales, where rows have them."""
    given = part if scratch is None else part | {"scales": scratch[: len(part["scales"])]}
    with np.errstate(over="ignore", invalid="ignore"):
        rows.fill(first, given)
    if scratch is not None:
        _split(given["quats"], given["scales"], part)
    return find_defects({name: given[name] for name in _CHECKED if name in given})


def _split(quats: np.ndarray, three: np.ndarray, part: dict[str, np.ndarray]) -> None:
    """Puts three scales (n, 3) where two and the thickness belong. Splats of no extent along an axis get
    frames, quats (n, 4), in which it is the third; NaN stays where it is."""
    flat = (three[:, :2] == 0).any(axis=1) & ~np.isnan(three).any(axis=1)
    if flat.any():
        quats[flat], three[flat] = with_thinnest_last(quats[flat], three[flat])
    three[np.isclose(three[:, 2], np.exp(PADDED_LOG_SCALE), rtol=1e-5, atol=0), 2] = 0
    part["scales"][:], part["thickness"][:] = three[:, :2], three[:, 2]


class _Kept:
    """Arrays that grow with the splats that are kept in them."""

    def __init__(self, columns: dict[str, tuple[tuple[int, ...], type]], most: int) -> None:
        self._most, self._count, self._room = most, 0, min(most, _FIRST_ROOM)
        self._arrays = {name: np.empty((self._room, *shape), kind) for name, (shape, kind) in columns.items()}

    def room(self, count: int, seen: int) -> dict[str, np.ndarray]:
        """The places of the next splats, as many as that; seen: rows of the file so far."""
        if self._count + count > self._room:
            # of a file that is mostly splats, all of what is left is expected
            self._room = self._most if 2 * self._count > seen else min(self._most, 2 * self._room + count)
            for name, old in self._arrays.items():
                self._arrays[name] = np.empty((self._room, *old.shape[1:]), old.dtype)
                self._arrays[name][: self._count] = old[: self._count]
        return {name: array[self._count : self._count + count] for name, array in self._arrays.items()}

    def keep(self, part: dict[str, np.ndarray], good: np.ndarray | None) -> None:
        """Keep those of the last places that are good, (n,) bool; None: all."""
        count = len(part["means"]) if good is None else int(good.sum())
        for array in part.values() if good is not None else ():
            array[:count] = array[good]
        self._count += count

    def finished(self) -> dict[str, np.ndarray]:
        """The arrays, as long as what is kept. Nothing may use a part of `room` after this."""
        for array in self._arrays.values():
            array.resize((self._count, *array.shape[1:]), refcheck=False)  # gives its end back without a copy
        return self._arrays
