"""Conversion of a file's rows to splats, in windows of bounded size.

Invalid rows are dropped in each window, so that memory is proportional to the number of valid splats, not to
the count that the file declares.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.splats.arrays import find_defects, with_thinnest_last
from fidsplat.util import interrupts
from fidsplat.util.progress import Progress

PADDED_LOG_SCALE = np.log(1e-6)
"""log of the third scale that marks a disk, for tools that require three scales; as SuperSplat writes it"""
WINDOW = 65536
"""rows per window; smaller windows spend more time on validation than on reading"""
BLOCK = 2048
"""rows per block of a window: few enough that records and arrays stay in a core's cache"""
_INITIAL_CAPACITY = 1_000_000  # splats

_CHECKED = ("means", "quats", "scales", "opacities", "sh", "colors")


@dataclass(frozen=True)
class Rows:
    """Unvalidated rows of a file, one for each splat."""

    path: Path
    count: int
    columns: dict[str, tuple[tuple[int, ...], type]]
    """shape and type per row of each array: means, quats, scales (2 or 3), opacities, sh or colors, and
    optionally labels and coplanar_groups"""
    fill: Callable[[int, dict[str, np.ndarray]], None]
    """fills the given arrays with rows, from a first row on"""

    @property
    def thick(self) -> bool:
        """Whether the rows have three scales."""
        return self.columns["scales"][0] == (3,)

    @property
    def splat_columns(self) -> dict[str, tuple[tuple[int, ...], type]]:
        """Shape and type per row of each array of the cloud."""
        thickness: dict[str, tuple[tuple[int, ...], type]] = {"thickness": ((), np.float32)}
        return self.columns | {"scales": ((2,), np.float32)} | (thickness if self.thick else {})


def collect(rows: Rows, progress: Progress | None = None) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Read all rows; returns the arrays of the valid splats and the number of dropped rows by reason.

    The third scale becomes the thickness: 0 (a disk) for the padding 1e-6 or if one of the scales is 0.
    """
    thick, columns = rows.thick, rows.splat_columns
    growing = _GrowingArrays(columns, rows.count)
    scratch = np.empty((min(WINDOW, rows.count), 3), np.float32)
    dropped: dict[str, int] = {}
    for first in range(0, rows.count, WINDOW):
        interrupts.check()
        part = growing.reserve(min(WINDOW, rows.count - first), first)
        good, reasons = _read_part(rows, first, part, scratch if thick else None)
        growing.append(part, good)
        for reason, count in reasons.items():
            dropped[reason] = dropped.get(reason, 0) + count
        if progress is not None:
            progress(f"reading {rows.path.name}", min(1.0, (first + WINDOW) / rows.count))
    return growing.trimmed(), dropped


def window(rows: Rows, first: int, end: int) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Read rows [first, end), for bounded memory; returns valid splats and numbers of dropped rows by
    reason."""
    count = end - first
    part = {name: np.empty((count, *shape), kind) for name, (shape, kind) in rows.splat_columns.items()}
    good, dropped = _read_part(rows, first, part, np.empty((count, 3), np.float32) if rows.thick else None)
    return part if good is None else {name: array[good] for name, array in part.items()}, dropped


def _read_part(
    rows: Rows, first: int, part: dict[str, np.ndarray], scratch: np.ndarray | None
) -> tuple[np.ndarray | None, dict[str, int]]:
    """Read rows from `first` on into arrays.

    scratch: buffer (n, 3) if the rows have three scales.

    Returns which splats are valid, (n,) bool or None for all, and the number of invalid splats by reason.
    """
    read = part if scratch is None else part | {"scales": scratch[: len(part["scales"])]}
    with np.errstate(over="ignore", invalid="ignore"):
        rows.fill(first, read)
    if scratch is not None:
        _split(read["quats"], read["scales"], part)
    return find_defects({name: read[name] for name in _CHECKED if name in read})


def _split(quats: np.ndarray, three: np.ndarray, part: dict[str, np.ndarray]) -> None:
    """Split three scales (n, 3) into two scales and the thickness. If an axis has extent 0, the quaternions
    (n, 4) are changed such that it is the third axis. NaN stays in its column."""
    flat = (three[:, :2] == 0).any(axis=1) & ~np.isnan(three).any(axis=1)
    if flat.any():
        quats[flat], three[flat] = with_thinnest_last(quats[flat], three[flat])
    three[np.isclose(three[:, 2], np.exp(PADDED_LOG_SCALE), rtol=1e-5, atol=0), 2] = 0
    part["scales"][:], part["thickness"][:] = three[:, :2], three[:, 2]


class _GrowingArrays:
    """Arrays whose capacity grows as splats are appended."""

    def __init__(self, columns: dict[str, tuple[tuple[int, ...], type]], maximum: int) -> None:
        self._maximum, self._count, self._capacity = maximum, 0, min(maximum, _INITIAL_CAPACITY)
        self._arrays = {
            name: np.empty((self._capacity, *shape), kind) for name, (shape, kind) in columns.items()
        }

    def reserve(self, count: int, rows: int) -> dict[str, np.ndarray]:
        """Views of the arrays for the next `count` splats. rows: number of rows read so far."""
        if self._count + count > self._capacity:
            # if most rows so far are valid, allocate for all remaining rows
            mostly_valid = 2 * self._count > rows
            self._capacity = self._maximum if mostly_valid else min(self._maximum, 2 * self._capacity + count)
            for name, old in self._arrays.items():
                self._arrays[name] = np.empty((self._capacity, *old.shape[1:]), old.dtype)
                self._arrays[name][: self._count] = old[: self._count]
        return {name: array[self._count : self._count + count] for name, array in self._arrays.items()}

    def append(self, part: dict[str, np.ndarray], good: np.ndarray | None) -> None:
        """Append the reserved rows that are valid, (n,) bool; None: all."""
        count = len(part["means"]) if good is None else int(good.sum())
        for array in part.values() if good is not None else ():
            array[:count] = array[good]
        self._count += count

    def trimmed(self) -> dict[str, np.ndarray]:
        """Arrays without unused capacity; invalidates the views of `reserve`."""
        for array in self._arrays.values():  # frees unused capacity without a copy
            array.resize((self._count, *array.shape[1:]), refcheck=False)
        return self._arrays
