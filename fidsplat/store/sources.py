"""Splat files from which a store (chunks on disk) is built, read in windows of rows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fidsplat.formats.collect import WINDOW, Rows, window
from fidsplat.formats.files import format_of, load_splats
from fidsplat.formats.ply import ply_rows
from fidsplat.splats.arrays import all_scales, choose_origin, group_offsets, present_arrays, unit_quaternions
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import colors_of_degree
from fidsplat.util.arguments import invalid
from fidsplat.util.errors import InputError
from fidsplat.util.files import path_of

_SAMPLES, _SAMPLE = 64, 4096
"""maximum number of windows of each source, and rows of a window, that are sampled for bounds"""


@dataclass(frozen=True)
class Source:
    """One input of a store."""

    rows: Rows
    origin: np.ndarray
    """(3,) float64 metres: world position that means are relative to"""
    stamp: str
    """path, size and modification time of the file, to detect changes"""
    first_group: int = 0
    """offset added to its coplanar group ids, so that groups of different inputs stay different"""


def open_sources(inputs: Sequence[str | os.PathLike[str] | Source]) -> list[Source]:
    """Open splat files. Raises InputError for an empty list or a file that cannot be read."""
    if isinstance(inputs, (str, os.PathLike)):
        inputs = [inputs]
    if not isinstance(inputs, Sequence):
        raise invalid("inputs", "a list of splat files", inputs)
    opened = [source if isinstance(source, Source) else _open(path_of(source)) for source in inputs]
    if not opened:
        raise InputError("inputs must be at least one splat file, got none")
    return with_distinct_groups(opened)


def _open(file: Path) -> Source:
    status = file.stat() if file.exists() else None  # a missing file is reported by its reader
    stamp = "" if status is None else f"{file.resolve()} {status.st_size} {status.st_mtime_ns}"
    if format_of(file).name != "PLY":
        return source_of(load_splats(file), file, stamp)
    rows, origin = ply_rows(file)
    return Source(rows, np.zeros(3) if origin is None else origin, stamp)


def source_of(cloud: SplatCloud, name: Path, stamp: str) -> Source:
    """A source of the splats of a cloud."""
    if cloud.boxes is not None:
        raise InputError(
            "splats of a store must be Gaussians, got box splats; put markers into a scene file next to it"
        )
    arrays = present_arrays(cloud) | {"scales": all_scales(cloud)}
    arrays.pop("thickness", None)
    columns = {name: (array.shape[1:], array.dtype.type) for name, array in arrays.items()}

    def fill(first: int, into: dict[str, np.ndarray]) -> None:
        for key, array in arrays.items():
            into[key][:] = array[first : first + len(into[key])]

    return Source(Rows(name, len(cloud), columns, fill), cloud.origin, stamp)


def with_distinct_groups(sources: list[Source]) -> list[Source]:
    """The sources, with distinct coplanar group ids."""
    offsets = group_offsets([_last_group(source.rows) for source in sources])
    return [replace(source, first_group=first) for source, first in zip(sources, offsets, strict=True)]


def _last_group(rows: Rows) -> int:
    """Largest coplanar group id; -1 without."""
    if "coplanar_groups" not in rows.columns:
        return -1
    parts = (window(rows, *span)[0]["coplanar_groups"] for span in spans(rows.count, WINDOW))
    return max((int(ids.max(initial=-1)) for ids in parts), default=-1)


def spans(count: int, size: int) -> list[tuple[int, int]]:
    """Ranges [first, end) of at most `size` that cover [0, count)."""
    return [(first, min(first + size, count)) for first in range(0, count, size)]


def degree_of(source: Source) -> int:
    """SH degree of a source; -1 for plain colours and for SH of degree 0."""
    if "sh" not in source.rows.columns:
        return -1
    terms = source.rows.columns["sh"][0][0]
    return -1 if terms == 1 else int(np.sqrt(terms)) - 1


def sample(sources: Sequence[Source]) -> tuple[np.ndarray, np.ndarray]:
    """Sampled centres (n, 3) float32 [m] of all sources, and the origin (3,) float64 that they are relative
    to: the common origin of the sources, or else a point near the splats."""
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
    """Splats of a range of rows, with a store's columns and relative to its origin; and the number of invalid
    splats by reason."""
    part, dropped = window(source.rows, *span)
    count = len(part["means"])
    means = part["means"]
    if means.dtype != np.float32 or not np.array_equal(source.origin, origin):
        means = (means.astype(np.float64) + (source.origin - origin)).astype(np.float32)
    splats = {"means": means, "quats": unit_quaternions(part["quats"])}
    splats |= {name: part[name] for name in ("scales", "opacities")}
    splats |= colors_of_degree(part, sh_degree)
    if "thickness" in columns:
        splats["thickness"] = part.get("thickness", np.zeros(count, np.float32))
    if "labels" in columns:
        splats["labels"] = part.get("labels", np.zeros(count, np.int32))
    if "coplanar_groups" in columns:
        ids = part.get("coplanar_groups", np.full(count, -1, np.int32))
        splats["coplanar_groups"] = np.where(ids >= 0, ids + source.first_group, -1).astype(np.int32)
    return {name: splats[name].astype(kind, copy=False) for name, kind in columns.items()}, dropped
