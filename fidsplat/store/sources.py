"""What a store is built of: files of splats, PLY files mapped and all others loaded, as rows that are read in
parts and brought to one set of columns."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fidsplat.formats.collect import WINDOW, Rows, window
from fidsplat.formats.files import format_of, load_splats
from fidsplat.formats.ply import ply_rows
from fidsplat.splats.arrays import choose_origin, unit_quaternions
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.partial_cloud import colors_of_degree
from fidsplat.util.arguments import invalid
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

_SAMPLES, _SAMPLE = 64, 4096
"""parts of each source, and rows of each, by which bounds and the spread of splats are judged"""


@dataclass(frozen=True)
class Source:
    """One input: its rows, and the origin (3,) float64 [m] that they are relative to."""

    rows: Rows
    origin: np.ndarray
    stamp: str
    """what tells this state of the input from a later one"""
    first_plane: int = 0
    """what its planes' ids are raised by, so that planes of different inputs stay different"""


def open_sources(inputs: Sequence[str | os.PathLike[str] | Source]) -> list[Source]:
    """Raises InputError for no input, and as `load_splats` for a path of no file of splats."""
    if isinstance(inputs, (str, os.PathLike)):
        inputs = [inputs]
    if not isinstance(inputs, Sequence):
        raise invalid("inputs", "a list of files of splats", inputs)
    opened = [one if isinstance(one, Source) else _open(path_of(one)) for one in inputs]
    if not opened:
        raise InputError("a store is built of files of splats; give one at least")
    return with_planes_apart(opened)


def _open(file: Path) -> Source:
    if format_of(file).name == "PLY":
        rows, origin = ply_rows(file)
        status = file.stat()
        stamp = f"{file.resolve()} {status.st_size} {status.st_mtime_ns}"
        return Source(rows, np.zeros(3) if origin is None else origin, stamp)
    status = file.stat() if file.exists() else None
    cloud = load_splats(file)
    stamp = "" if status is None else f"{file.resolve()} {status.st_size} {status.st_mtime_ns}"
    return source_of(cloud, file, stamp)


def source_of(cloud: SplatCloud, name: Path, stamp: str) -> Source:
    """A cloud in memory as a source."""
    if cloud.boxes is not None:
        raise InputError("a store holds no boxes; put markers into a scene file beside it")
    arrays = {"means": cloud.means, "quats": cloud.quats, "opacities": cloud.opacities}
    scales = cloud.scales
    if cloud.thickness is not None:
        scales = np.column_stack([scales, cloud.thickness])
    arrays |= {"scales": scales, "labels": cloud.labels}
    some = {"colors": cloud.colors, "sh": cloud.sh, "planes": cloud.planes}
    arrays |= {key: array for key, array in some.items() if array is not None}
    columns = {name: (array.shape[1:], array.dtype.type) for name, array in arrays.items()}

    def fill(first: int, into: dict[str, np.ndarray]) -> None:
        for key, array in arrays.items():
            into[key][:] = array[first : first + len(into[key])]

    return Source(Rows(name, len(cloud), columns, fill), cloud.origin, stamp)


def with_planes_apart(sources: list[Source]) -> list[Source]:
    """The sources, with ids of planes that no two have in common."""
    made, free = [], 0
    for source in sources:
        made.append(Source(source.rows, source.origin, source.stamp, free))
        if "planes" in source.rows.columns:
            parts = (window(source.rows, *span)[0]["planes"] for span in spans(source.rows.count, WINDOW))
            free += 1 + max((int(ids.max(initial=-1)) for ids in parts), default=-1)
    return made


def spans(count: int, size: int) -> list[tuple[int, int]]:
    """Ranges [first, end) of at most `size` that together are [0, count)."""
    return [(first, min(first + size, count)) for first in range(0, count, size)]


def degree_of(source: Source) -> int:
    """SH degree of a source; -1 for plain colours, which SH of degree 0 are as well."""
    if "sh" not in source.rows.columns:
        return -1
    terms = source.rows.columns["sh"][0][0]
    return -1 if terms == 1 else int(np.sqrt(terms)) - 1


def sample(sources: Sequence[Source]) -> tuple[np.ndarray, np.ndarray]:
    """Centres (n, 3) float32 [m] of some splats of all sources, and the origin (3,) float64 that they are
    relative to: that of all sources where they agree, else one that is near."""
    means, single, scales = [], [], []
    for source in sources:
        count = source.rows.count
        step = max(WINDOW, -(-count // _SAMPLES // WINDOW) * WINDOW)
        for first in range(0, count, step):
            part, _ = window(source.rows, first, min(first + _SAMPLE, count))
            means.append(part["means"].astype(np.float64) + source.origin)
            single.append(part["means"].astype(np.float32))
            scales.append(part["scales"])
    origins = [source.origin for source in sources]
    world = np.concatenate(means) if means else np.zeros((0, 3))
    narrow = all(source.rows.columns["means"][1] is np.float32 for source in sources)
    if narrow and all(np.array_equal(origin, origins[0]) for origin in origins):
        return np.concatenate(single) if single else np.zeros((0, 3), np.float32), origins[0]
    _, origin = choose_origin(world, world.astype(np.float32), np.concatenate(scales))
    return (world - origin).astype(np.float32), origin


def splats_of(
    source: Source, span: tuple[int, int], origin: np.ndarray, columns: dict[str, str], sh_degree: int
) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """The splats of a range of rows in the columns of a store, relative to its origin (3,) float64, and how
    many cannot be drawn for each reason."""
    part, dropped = window(source.rows, *span)
    count = len(part["means"])
    means = part["means"]
    if means.dtype != np.float32 or not np.array_equal(source.origin, origin):
        means = (means.astype(np.float64) + (source.origin - origin)).astype(np.float32)
    made = {"means": means, "quats": unit_quaternions(part["quats"])}
    made |= {name: part[name] for name in ("scales", "opacities")}
    made |= colors_of_degree(part, sh_degree)
    if "thickness" in columns:
        made["thickness"] = part.get("thickness", np.zeros(count, np.float32))
    if "labels" in columns:
        made["labels"] = part.get("labels", np.zeros(count, np.int32))
    if "planes" in columns:
        ids = part.get("planes", np.full(count, -1, np.int32))
        made["planes"] = np.where(ids >= 0, ids + source.first_plane, -1).astype(np.int32)
    return {name: made[name].astype(kind, copy=False) for name, kind in columns.items()}, dropped
