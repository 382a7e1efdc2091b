"""On-disk format of a store: a folder of NumPy files that can be memory-mapped, and a JSON header.

    city.fss/store.json       format version, counts, origin, kinds of splats, names of the sources
    city.fss/nodes.npy        a record for each chunk and each node of the levels of detail (`NODE`)
    city.fss/means.npy ...    a column for each array: the splats of all chunks in their order, then the
                              merged splats of the levels of detail
    city.fss/places.npy       in an instanced store instead of columns: poses (p, 4, 4) of another store
    city.fss/detail.json      measured errors of the levels of detail, if any

The index of a splat is its row. A chunk is a run of rows, so that a selection of chunks keeps the order of
the scene, by which splats of equal depth are sorted.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from fidsplat.util.arguments import LARGEST
from fidsplat.util.errors import InputError, os_errors
from fidsplat.util.files import from_json, open_input, read_input, write_json
from fidsplat.util.limits import check_holes
from fidsplat.util.npy import load_npy, save_npy

FORMAT, VERSION = "fidsplat store", 1
SUFFIX = ".fss"
HEADER, NODES, PLACES = "store.json", "nodes.npy", "places.npy"
CHUNK = 32768
"""splats of a chunk: few enough for culling, enough for a sequential read of about 2 MB"""
FAR = 5.0
"""extent of the larger boxes of a node, in standard deviations"""
MAX_CHUNK = 2**22
"""limit on the splats of a chunk, which are read at once"""
MAX_SPLATS = 2**31 - 1
"""limit on the splats of a scene: indices are int32"""
NPY_HEADER = 128
"""bytes of the header of a column file"""

_MAX_NODE = 2**24
"""limit on the splats of a node of the levels of detail, which merges four of the level below"""
_MAX_ROWS = 2**32
"""limit on the rows of a store: its splats and the merged splats of all levels of detail"""
_TYPES = dict.fromkeys(("means", "quats", "scales", "opacities", "thickness"), ("<f4",))
_TYPES |= dict.fromkeys(("labels", "coplanar_groups"), ("<i4",))
"""allowed NumPy types of each column"""

NODE = np.dtype(
    [
        ("first", "<i8"),  # row
        ("count", "<i4"),  # splats
        ("level", "<i4"),  # 0: a chunk of the scene; above: a level of detail
        ("parent", "<i4"),  # the node of the next level that replaces it and its neighbours; -1: none
        ("crc", "<u4"),  # CRC-32 of its rows, column after column
        ("size", "<f4"),  # metres: edge of the cells whose splats were merged; 0 on level 0
        ("reach", "<f4"),  # metres: largest standard deviation
        ("low", "<f4", 3),  # metres from the origin: lowest corner of the box around the centres
        ("high", "<f4", 3),
        ("far_low", "<f4", 3),  # lowest corner of the box around splats to `FAR` standard deviations
        ("far_high", "<f4", 3),
    ]
)


@dataclass(frozen=True)
class Header:
    """Content of `store.json`."""

    splats: int
    """number of splats of the scene"""
    rows: int
    """number of rows, with the levels of detail"""
    pinned: int
    """first row of the splats of coplanar groups, which are part of every frame"""
    chunk: int
    """maximum number of splats of a chunk"""
    origin: tuple[float, float, float]
    """world position [m] that means are relative to"""
    sh_degree: int
    """SH degree 0 to 3; -1: plain colours"""
    columns: dict[str, str]
    """NumPy's type of each array, e.g. {"means": "<f4"}"""
    ellipsoids: str
    """which splats are 3D Gaussians: none, some, all"""
    nodes_crc: int
    """CRC-32 of nodes.npy"""
    identity: str
    """hexadecimal digest of the content"""
    dropped: dict[str, int] = field(default_factory=dict)
    """number of invalid splats of the sources, by reason"""
    sources: tuple[str, ...] = ()
    """names of the source files"""
    store: str | None = None
    """relative path of the other store, in an instanced store"""
    places_crc: int | None = None
    """CRC-32 of the poses, in an instanced store"""

    def save(self, folder: Path) -> None:
        """Write the header, as the last file of a store: a folder without it is not a store."""
        write_checked(folder / HEADER, {"format": FORMAT, "version": VERSION, **asdict(self)})


def write_checked(file: Path, content: dict[str, Any]) -> None:
    """Write a JSON object with its checksum `crc`."""
    write_json(file, content | {"crc": header_crc(content)}, indent=1)


def header_crc(content: Mapping[str, Any]) -> int:
    """CRC-32 of the fields of a JSON object except the checksum."""
    rest = {name: value for name, value in content.items() if name != "crc"}
    return zlib.crc32(json.dumps(rest, sort_keys=True).encode())


def read_header(folder: Path) -> Header:
    """Read a header. Raises InputError if the folder is not a store, or a store of another version."""
    file = folder / HEADER
    try:
        content = from_json(read_input(file))
    except InputError as error:
        if not file.exists():
            raise InputError(
                f"{folder} must be a store with {HEADER}, got a folder without it; build one with `fidsplat "
                "store build`"
            ) from None
        raise error
    except ValueError:
        raise InputError(f"{file} is damaged: it is not JSON; build the store again") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{folder} is not a store: its {HEADER} has another format; build the store again")
    version = content.get("version")
    if version != VERSION:
        raise InputError(
            f"the version of the store {folder} must be {VERSION}, got {version!r}; use the fidsplat that "
            "wrote it, or build it again"
        )
    try:
        if content.get("crc") != header_crc(content):
            raise ValueError("its checksum differs")
        known: dict[str, Any] = {field.name: content[field.name] for field in fields(Header)}
        known |= {name: tuple(known[name]) for name in ("sources", "origin")}
        header = Header(**known)
        _check(header)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file} is damaged ({error}); build the store again") from None
    return header


def _check(header: Header) -> None:
    tables = isinstance(header.columns, dict) and isinstance(header.dropped, dict)
    counts = (header.splats, header.rows, header.pinned, header.chunk, header.sh_degree, header.nodes_crc)
    if not tables or not all(type(value) is int for value in (*counts, *header.dropped.values())):
        raise ValueError("columns or dropped is not a table, or counts are not whole numbers")
    if (
        not 0 <= header.pinned <= header.splats <= header.rows <= _MAX_ROWS
        or not 0 < header.chunk <= MAX_CHUNK
        or not -1 <= header.sh_degree <= 3
    ):
        raise ValueError("a count is out of range")
    if not all(
        isinstance(text, str)
        for text in (header.identity, *([header.store] if header.store is not None else []), *header.sources)
    ):
        raise ValueError("a name is not text")
    if len(header.origin) != 3 or not np.abs(header.origin).max() <= LARGEST:
        raise ValueError("the origin is not a point")
    types = _TYPES | {"colors" if header.sh_degree < 0 else "sh": ("<f2", "<f4")}
    for name, kind in header.columns.items():
        if kind not in types.get(name, ()):
            allowed = " or ".join(types.get(name, ())) or "none"
            raise ValueError(f"the column {name} must have the type {allowed}, got {kind}")
    # all but three columns are in every store
    if missing := types.keys() - {"labels", "coplanar_groups", "thickness"} - header.columns.keys():
        raise ValueError(f"no column {min(missing)}")
    if header.ellipsoids not in ("none", "some", "all"):
        raise ValueError(f"ellipsoids must be none, some or all, got {header.ellipsoids!r}")
    if header.ellipsoids != "none" and "thickness" not in header.columns:
        raise ValueError("3D Gaussians need a column thickness")


def shapes_of(sh_degree: int) -> dict[str, tuple[int, ...]]:
    """Shape of one splat in each possible column."""
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "scales": (2,), "opacities": ()}
    shapes |= {"labels": (), "coplanar_groups": (), "thickness": ()}
    return shapes | ({"colors": (3,)} if sh_degree < 0 else {"sh": ((sh_degree + 1) ** 2, 3)})


def npy_header(kind: str, shape: tuple[int, ...]) -> bytes:
    """Header of a .npy file, of fixed length, so that it can be written after the rows."""
    text = f"{{'descr': '{np.dtype(kind).str}', 'fortran_order': False, 'shape': {shape!r}, }}"
    body = text.encode("ascii").ljust(NPY_HEADER - 11) + b"\n"
    return b"\x93NUMPY\x01\x00" + (NPY_HEADER - 10).to_bytes(2, "little") + body


def column_file(folder: Path, name: str) -> Path:
    """Path of a column."""
    return folder / f"{name}.npy"


def row_bytes(kind: str, shape: tuple[int, ...]) -> int:
    """Bytes of one splat in a column."""
    return np.dtype(kind).itemsize * int(np.prod(shape, dtype=np.int64))


def checksum(parts: Mapping[str, np.ndarray]) -> int:
    """CRC-32 of a chunk's stored arrays, in the order of the header's columns."""
    crc = 0
    for array in parts.values():
        crc = zlib.crc32(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data, crc)
    return crc


def map_column(folder: Path, name: str, kind: str, shape: tuple[int, ...], starts: np.ndarray) -> np.ndarray:
    """Memory-map a column (rows, ...), read-only.

    starts: (n,) first rows of the nodes, to name the first missing chunk of a truncated file. Raises
    InputError if the file is missing, truncated or does not match the header.
    """
    file, header = column_file(folder, name), npy_header(kind, shape)
    size = NPY_HEADER + row_bytes(kind, shape[1:]) * shape[0]
    try:
        with open_input(file) as stream:
            start, found_size = stream.read(NPY_HEADER), os.fstat(stream.fileno()).st_size
    except InputError as error:
        raise InputError(f"{error}; the store is incomplete") from error
    if found_size < size:
        lost = max(found_size - NPY_HEADER, 0) // max(row_bytes(kind, shape[1:]), 1)
        chunk = max(int(np.searchsorted(starts, lost, "right")) - 1, 0)
        raise InputError(
            f"{file} is truncated: it has {found_size} bytes of {size}, so rows from {lost} on are missing, "
            f"from chunk {chunk} on; build the store again"
        )
    if start != header or found_size > size:
        raise InputError(
            f"{file} does not belong to this store, or its header is damaged; build the store again"
        )
    if not shape[0]:
        return np.empty(shape, kind)
    check_holes(file)
    with os_errors(f"cannot map {file} into memory"):  # for instance by a limit on the address space
        return np.memmap(file, kind, "r", NPY_HEADER, shape).view(np.ndarray)


def write_nodes(folder: Path, nodes: np.ndarray) -> int:
    """Write the index and return the CRC-32 of its records."""
    save_npy(folder / NODES, nodes)
    return zlib.crc32(nodes.tobytes())


def read_nodes(folder: Path, header: Header) -> np.ndarray:
    """Read the index, (n,) of `NODE`. Raises InputError if missing, damaged or inconsistent."""
    file = folder / NODES
    try:
        nodes = load_npy(file)
    except InputError as error:
        raise InputError(f"{error}; the store is incomplete") from error
    except ValueError:
        nodes = np.empty(0)
    if nodes.dtype != NODE or nodes.ndim != 1 or zlib.crc32(nodes.tobytes()) != header.nodes_crc:
        raise InputError(f"{file} is damaged: its checksum differs; build the store again")
    if wrong := _contradiction(nodes, header):
        raise InputError(f"{file} does not match {HEADER}: {wrong}; build the store again")
    return nodes


def _contradiction(nodes: np.ndarray, header: Header) -> str:
    """Describe a contradiction between an index and its header; empty if there is none."""
    first, count, level, parent = (
        nodes[name].astype(np.int64) for name in ("first", "count", "level", "parent")
    )
    chunk, ends = level == 0, np.cumsum(count)
    if (count < 1).any() or (count[chunk] > header.chunk).any():
        return f"a node must have 1 to {header.chunk} splats, got {int(count.min())} to {int(count.max())}"
    if count.max(initial=0) > _MAX_NODE:
        return f"a node of the levels of detail must have at most {_MAX_NODE} splats, got {int(count.max())}"
    if ends.max(initial=0) != header.rows or (first != ends - count).any():
        return f"its nodes must cover {header.rows} rows without gaps"
    if not np.isin(np.diff(level, prepend=0), (0, 1)).all():
        return "levels must rise from 0, one by one"
    if count[chunk].sum() != header.splats:
        return f"its chunks must have {header.splats} splats, got {int(count[chunk].sum())}"
    if header.pinned not in {*first[chunk].tolist(), header.splats}:
        return "splats of coplanar groups must begin with a chunk"
    above = np.flatnonzero(parent != -1)
    if not ((parent >= -1) & (parent < len(nodes))).all() or (level[parent[above]] != level[above] + 1).any():
        return "a node's parent must be in the level above"
    if (parent[chunk & (first >= header.pinned)] != -1).any():
        return "splats of coplanar groups must have no parent"
    lengths = ("size", "reach", "low", "high", "far_low", "far_high")
    if not all(np.isfinite(nodes[name]).all() for name in lengths):
        return "sizes and boxes must be finite"
    if (nodes["size"] < 0).any() or (nodes["size"][chunk] != 0).any() or (nodes["reach"] < 0).any():
        return "sizes must be at least 0, and 0 for chunks"
    corners = [nodes[name] for name in ("far_low", "low", "high", "far_high")]
    if any((a > b).any() for a, b in pairwise(corners)):
        return "a box must be within the larger box of its node"
    return ""
