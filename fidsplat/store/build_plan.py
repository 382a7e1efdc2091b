"""What a store will be, decided before a byte of it is written: the same for the same inputs, so that a build
that was stopped can go on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.formats.collect import WINDOW
from fidsplat.store.layout import CHUNK, MAX_SPLATS, NODE, row_bytes, shapes_of
from fidsplat.store.merge import REDUCTION
from fidsplat.store.morton import Grid, grid_around
from fidsplat.store.sources import Source, degree_of, sample, spans
from fidsplat.util.arguments import flag, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import printable

COLORS = ("float32", "float16")
_MOST_BUCKETS = 1000
_LEAST_MEMORY = 256 * 2**20
_MERGING = 400, 6
"""bytes of a splat that is merged, and how many times its own beside them: 610 in all were measured with
plain colours, 1,530 with harmonics of degree 3"""
ON_PLANE = np.uint64(1 << 63)
"""code of splats that are printed on planes: they stand last, in chunks of their own, which every picture
has, since a plane is placed as a whole"""


@dataclass(frozen=True)
class Plan:
    """The columns of a store, its order, and the parts in which it is built."""

    sources: tuple[Source, ...]
    chunk: int
    memory: int
    """bytes that building may take, roughly"""
    levels: bool
    sh_degree: int
    columns: dict[str, str]
    origin: np.ndarray
    grid: Grid
    splitters: np.ndarray
    """(buckets - 1,) uint64: first codes of all buckets but the first"""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of a splat's part of each column."""
        every = shapes_of(self.sh_degree)
        return {name: every[name] for name in self.columns}

    @property
    def splat_bytes(self) -> int:
        """Bytes of a splat in all columns."""
        return sum(row_bytes(kind, self.shapes[name]) for name, kind in self.columns.items())

    @property
    def merge_bytes(self) -> int:
        """Bytes that it takes to make one node of those below it, at most."""
        each, share = _MERGING
        return int(REDUCTION * min(self.chunk, self.rows) * (each + share * self.splat_bytes))

    @cached_property
    def record(self) -> np.dtype:
        """A splat on its way to its bucket."""
        parts = [(name, kind, self.shapes[name]) for name, kind in self.columns.items()]
        return np.dtype([("code", "<u8"), *parts])

    @property
    def rows(self) -> int:
        """Rows of all inputs."""
        return sum(source.rows.count for source in self.sources)

    @cached_property
    def windows(self) -> list[tuple[int, tuple[int, int]]]:
        """The parts in which inputs are read: which input, and its rows [first, end)."""
        step = max(1, self.memory // (24 * self.record.itemsize) // WINDOW) * WINDOW
        step = min(step, 4 * WINDOW)
        parts = [spans(source.rows.count, step) for source in self.sources]
        return [(number, span) for number, own in enumerate(parts) for span in own]

    @property
    def disk_bytes(self) -> int:
        """Bytes that a build takes of the disk at most, roughly: records in buckets, columns, levels."""
        whole = self.splat_bytes * 4 // 3 if self.levels else self.splat_bytes
        return self.rows * (self.record.itemsize + whole) + self.rows // self.chunk * 2 * NODE.itemsize

    @cached_property
    def digest(self) -> str:
        """Hexadecimal digits of all that decides what is built."""
        sha = hashlib.sha256()
        for source in self.sources:
            sha.update(printable(f"{source.stamp} {source.rows.count} {source.first_plane}\n").encode())
        own = (self.chunk, self.memory, self.levels, self.sh_degree, self.columns, self.grid)
        sha.update(repr(own).encode() + self.origin.tobytes() + self.splitters.tobytes())
        return sha.hexdigest()


def plan_of(
    sources: Sequence[Source],
    chunk: int = CHUNK,
    memory: int = 2 * 2**30,
    levels: bool = True,
    sh_degree: int | None = None,
    colors: str = "float32",
) -> Plan:
    """Raises InputError for a number that cannot be used."""
    if isinstance(chunk, bool) or not isinstance(chunk, int) or not 64 <= chunk <= 1 << 22:
        raise InputError(f"chunk is {chunk!r}; it must be a whole number of splats from 64 to {1 << 22}")
    if isinstance(memory, bool) or not isinstance(memory, int) or memory < _LEAST_MEMORY:
        raise InputError(f"memory is {memory!r}; building takes at least {_LEAST_MEMORY >> 20} MiB")
    flag("levels", levels)
    if not isinstance(colors, str) or colors not in COLORS:
        raise InputError(f"colors is {colors!r}; known: {', '.join(COLORS)}")
    if sh_degree is not None:
        whole_number("sh_degree", sh_degree, 0, 3)
    degree = max(map(degree_of, sources))
    if sh_degree is not None:
        degree = min(degree, sh_degree) or -1
    kinds = {"means": "<f4", "quats": "<f4", "scales": "<f4", "opacities": "<f4"}
    kinds["colors" if degree < 0 else "sh"] = "<f4" if colors == "float32" else "<f2"
    given = [source.rows for source in sources]
    if any(rows.thick for rows in given):
        kinds["thickness"] = "<f4"
    kinds |= {name: "<i4" for name in ("labels", "planes") if any(name in rows.columns for rows in given)}
    means, origin = sample(sources)
    grid = grid_around(means)
    wide = sum(row_bytes(kind, shapes_of(degree)[name]) for name, kind in kinds.items()) + 8
    rows = sum(each.count for each in given)
    if rows > MAX_SPLATS:
        raise InputError(f"{rows:,} splats are too many for a store: a scene has at most {MAX_SPLATS:,}")
    buckets = int(np.clip(-(-rows * wide // (memory // 16)), 1, _MOST_BUCKETS))
    codes = np.sort(grid.codes(means))
    splitters = codes[len(codes) * np.arange(1, buckets) // buckets] if len(codes) else codes
    splitters = np.unique(splitters)
    plan = Plan(tuple(sources), chunk, memory, levels, degree, kinds, origin, grid, splitters)
    if levels and plan.merge_bytes > memory:
        most, needed = memory * min(chunk, rows) // plan.merge_bytes, plan.merge_bytes / 2**20
        raise InputError(
            f"chunk is {chunk:,}; levels of detail of so large ones take {needed:,.0f} MiB to make, and "
            f"memory is {memory / 2**20:,.0f} MiB; take {most:,} at most, more memory, or no levels"
        )
    return plan
