"""Plan of a build: columns, order and windows of a store, deterministic so that a build can be resumed."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.formats.collect import WINDOW
from fidsplat.store.layout import CHUNK, MAX_CHUNK, MAX_SPLATS, NODE, row_bytes, shapes_of
from fidsplat.store.merge import REDUCTION
from fidsplat.store.morton import Grid, grid_around
from fidsplat.store.sources import Source, degree_of, sample, spans
from fidsplat.util.arguments import Bytes, flag, whole_number
from fidsplat.util.errors import InputError
from fidsplat.util.files import printable

COLORS = ("float32", "float16")
_MAX_BUCKETS = 1000
_MIN_MEMORY = 256 * 2**20
_MERGE_BYTES = 400, 6
"""memory per merged splat: a constant in bytes, and a multiple of its size"""
ON_PLANE = np.uint64(1 << 63)
"""Morton code that sorts coplanar splats last, into pinned chunks: every frame needs all splats of a group,
which is composited as one layer"""


@dataclass(frozen=True)
class BuildSettings:
    """Chunks and columns of a store. Raises InputError for an unusable value."""

    chunk: int = CHUNK
    """maximum number of splats per chunk"""
    memory: Bytes = 2 * 2**30
    """approximate memory while building, in bytes"""
    levels: bool = True
    """whether to store levels of detail"""
    sh_degree: int | None = None
    """maximum SH degree to store; None: the degree of the files"""
    colors: str = "float32"
    """type of colours and SH: float32 or float16"""

    def __post_init__(self) -> None:
        whole_number("chunk", self.chunk, 64, MAX_CHUNK)
        whole_number("memory", self.memory, _MIN_MEMORY, 2**63)
        flag("levels", self.levels)
        if not isinstance(self.colors, str) or self.colors not in COLORS:
            raise InputError(f"colors must be one of {', '.join(COLORS)}, got {self.colors!r}")
        if self.sh_degree is not None:
            whole_number("sh_degree", self.sh_degree, 0, 3)


@dataclass(frozen=True)
class BuildPlan:
    """Columns, order and windows of a build."""

    sources: tuple[Source, ...]
    settings: BuildSettings
    sh_degree: int
    columns: dict[str, str]
    origin: np.ndarray
    grid: Grid
    splitters: np.ndarray
    """(b,) uint64: first Morton code of each bucket of ungrouped splats, except the first bucket"""

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of one splat in each column."""
        every = shapes_of(self.sh_degree)
        return {name: every[name] for name in self.columns}

    @property
    def splat_bytes(self) -> int:
        """Bytes of a splat in all columns."""
        return sum(row_bytes(kind, self.shapes[name]) for name, kind in self.columns.items())

    @property
    def merge_bytes(self) -> int:
        """Maximum memory to merge nodes into one of the next level."""
        each, factor = _MERGE_BYTES
        return int(REDUCTION * min(self.settings.chunk, self.rows) * (each + factor * self.splat_bytes))

    @cached_property
    def record(self) -> np.dtype:
        """Record of a splat in a bucket file."""
        parts = [(name, kind, self.shapes[name]) for name, kind in self.columns.items()]
        return np.dtype([("code", "<u8"), *parts])

    @property
    def rows(self) -> int:
        """Number of splats in the files of all inputs."""
        return sum(source.rows.count for source in self.sources)

    @cached_property
    def windows(self) -> list[tuple[int, tuple[int, int]]]:
        """Windows in which inputs are read: (number of the input, rows [first, end))."""
        step = max(1, self.settings.memory // (24 * self.record.itemsize) // WINDOW) * WINDOW
        step = min(step, 4 * WINDOW)
        parts = [spans(source.rows.count, step) for source in self.sources]
        return [(number, span) for number, rows in enumerate(parts) for span in rows]

    @property
    def disk_bytes(self) -> int:
        """Approximate maximum disk space of a build: bucket records, columns, levels of detail."""
        columns = self.splat_bytes * 4 // 3 if self.settings.levels else self.splat_bytes
        return (
            self.rows * (self.record.itemsize + columns)
            + self.rows // self.settings.chunk * 2 * NODE.itemsize
        )

    @cached_property
    def digest(self) -> str:
        """Hexadecimal digest of inputs and settings, by which an interrupted build is resumed."""
        sha = hashlib.sha256()
        for source in self.sources:
            sha.update(printable(f"{source.stamp} {source.rows.count} {source.first_group}\n").encode())
        chosen = self.settings.chunk, self.settings.memory, self.settings.levels
        own = (*chosen, self.sh_degree, self.columns, self.grid)
        sha.update(repr(own).encode() + self.origin.tobytes() + self.splitters.tobytes())
        return sha.hexdigest()


def plan_build(sources: Sequence[Source], settings: BuildSettings | None = None) -> BuildPlan:
    """Plan a build. Raises InputError for a chunk that the memory does not allow, or too many splats."""
    settings = settings or BuildSettings()
    chunk, memory = settings.chunk, settings.memory
    degree = max(map(degree_of, sources))
    if settings.sh_degree is not None:
        degree = min(degree, settings.sh_degree) or -1
    kinds = {"means": "<f4", "quats": "<f4", "scales": "<f4", "opacities": "<f4"}
    kinds["colors" if degree < 0 else "sh"] = "<f4" if settings.colors == "float32" else "<f2"
    inputs = [source.rows for source in sources]
    if any(rows.thick for rows in inputs):
        kinds["thickness"] = "<f4"
    kinds |= {
        name: "<i4" for name in ("labels", "coplanar_groups") if any(name in rows.columns for rows in inputs)
    }
    means, origin = sample(sources)
    grid = grid_around(means)
    splat_bytes = sum(row_bytes(kind, shapes_of(degree)[name]) for name, kind in kinds.items()) + 8
    rows = sum(source.count for source in inputs)
    if rows > MAX_SPLATS:
        raise InputError(f"a store must have at most {MAX_SPLATS:,} splats, got {rows:,}")
    buckets = int(np.clip(-(-rows * splat_bytes // (memory // 16)), 1, _MAX_BUCKETS))
    codes = np.sort(grid.codes(means))
    splitters = codes[len(codes) * np.arange(1, buckets) // buckets] if len(codes) else codes
    splitters = np.unique(splitters)
    plan = BuildPlan(tuple(sources), settings, degree, kinds, origin, grid, splitters)
    if settings.levels and plan.merge_bytes > memory:
        max_chunk, needed = memory * min(chunk, rows) // plan.merge_bytes, plan.merge_bytes / 2**20
        raise InputError(
            f"chunk must be at most {max_chunk:,} for levels of detail in {memory / 2**20:,.0f} MiB, "
            f"got {chunk:,}, which needs {needed:,.0f} MiB; allow more memory, or no levels"
        )
    return plan
