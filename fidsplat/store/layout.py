"""What a store is on disk: a folder of NumPy files that others can map, and a header that says what is there.

    city.fss/store.json       the layout's version, counts, origin, traits, what it was made of
    city.fss/nodes.npy        a record for each chunk and for each node above the chunks (`NODE`)
    city.fss/means.npy ...    a column for each array: the splats of all chunks in their order, then those
                              that stand for others (levels of detail)
    city.fss/places.npy       instead of columns: the poses (p, 4, 4) at which another store stands
    city.fss/detail.json      what levels of detail were measured to cost, where they were

The index of a splat is its row. A chunk is a run of rows, so what is drawn of a store keeps the order of the
whole, by which ties of depth are decided.
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

from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, from_json, open_input, read_input
from fidsplat.util.npy import load_npy
from fidsplat.util.scalars import LARGEST

FORMAT, VERSION = "fidsplat store", 1
SUFFIX = ".fss"
HEADER, NODES, PLACES = "store.json", "nodes.npy", "places.npy"
CHUNK = 32768
"""splats of a chunk: small enough that what lies beside a picture is left out, large enough that reading one
is a sequential read of some 2 MB"""
FAR = 5.0
"""standard deviations to which the larger boxes of a node reach"""
MAX_SPLATS = 2**31 - 1
"""of a scene: their indices are int32"""
NPY_HEADER = 128
"""bytes of a column's own header, whatever its shape"""

_MOST_ROWS = 2**32
"""of a store: its splats, and those of all levels of detail, which are fewer"""
_TYPES = dict.fromkeys(("means", "quats", "scales", "opacities", "thickness"), ("<f4",))
_TYPES |= dict.fromkeys(("labels", "planes"), ("<i4",))
"""NumPy's types that a column may have"""

NODE = np.dtype(
    [
        ("first", "<i8"),  # row
        ("count", "<i4"),  # splats
        ("level", "<i4"),  # 0: a chunk of the scene itself; above: splats that stand for others
        ("parent", "<i4"),  # the node that stands for it and its neighbours; -1: none
        ("crc", "<u4"),  # of its rows of all columns, one after the other
        ("size", "<f4"),  # metres: edge of the cells whose splats were merged into one; 0 on level 0
        ("reach", "<f4"),  # metres: largest standard deviation
        ("low", "<f4", 3),  # metres from the origin: box around the centres
        ("high", "<f4", 3),
        ("far_low", "<f4", 3),  # the same around splats of `FAR` standard deviations
        ("far_high", "<f4", 3),
    ]
)


@dataclass(frozen=True)
class Header:
    """What `store.json` says."""

    splats: int
    """of the scene itself"""
    rows: int
    """with those that stand for others"""
    pinned: int
    """the first row of splats that are printed on planes, which every picture has"""
    chunk: int
    """splats of a chunk, at most"""
    origin: tuple[float, float, float]
    """metres: the world's position of the means' zero"""
    sh_degree: int
    """-1: plain colours"""
    columns: dict[str, str]
    """NumPy's type of each array, e.g. {"means": "<f4"}"""
    ellipsoids: str
    """which splats are 3D Gaussians: none, some, all"""
    nodes_crc: int
    """of the bytes of nodes.npy"""
    identity: str
    """hexadecimal digits that tell its content from every other's"""
    dropped: dict[str, int] = field(default_factory=dict)
    """splats of the sources that cannot be drawn, by the reason"""
    sources: tuple[str, ...] = ()
    """names of the files that it was made of"""
    store: str | None = None
    """of a store of places: the store that stands there, seen from this one's folder"""
    places_crc: int | None = None
    """of the bytes of its poses"""

    def save(self, folder: Path) -> None:
        """Write it; what is there without it is no store."""
        said = {"format": FORMAT, "version": VERSION, **asdict(self)}
        with atomic_write(folder / HEADER) as stream:
            stream.write(json.dumps(said | {"crc": header_crc(said)}, indent=1).encode())


def header_crc(said: Mapping[str, Any]) -> int:
    """CRC-32 of what a header says, beside the checksum itself."""
    rest = {name: value for name, value in said.items() if name != "crc"}
    return zlib.crc32(json.dumps(rest, sort_keys=True).encode())


def read_header(folder: Path) -> Header:
    """Raises InputError for what is no store, or one of a newer version."""
    file = folder / HEADER
    try:
        said = from_json(read_input(file))
    except InputError as error:
        if not file.exists():
            raise InputError(f"{folder} is not a store: it has no {HEADER}") from None
        raise error
    except ValueError:
        raise InputError(f"{file} is damaged: it is not JSON; build the store again") from None
    if not isinstance(said, dict) or said.get("format") != FORMAT:
        raise InputError(f"{folder} is not a store: its {HEADER} is of another kind")
    version = said.get("version")
    if version != VERSION:
        raise InputError(
            f"{folder} is a store of version {version!r}, and this fidsplat reads version {VERSION}; "
            "use the fidsplat that wrote it, or build it again"
        )
    try:
        if said.get("crc") != header_crc(said):
            raise ValueError("its checksum is another")
        known: dict[str, Any] = {each.name: said[each.name] for each in fields(Header)}
        known |= {name: tuple(known[name]) for name in ("sources", "origin")}
        header = Header(**known)
        _check(header)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{file} is damaged ({error}); build the store again") from None
    return header


def _check(header: Header) -> None:
    counts = (header.splats, header.rows, header.pinned, header.chunk, header.sh_degree, header.nodes_crc)
    if not all(type(value) is int for value in counts):
        raise ValueError("a count is no whole number")
    if not 0 <= header.splats <= header.rows <= _MOST_ROWS or not 0 < header.chunk <= MAX_SPLATS:
        raise ValueError("a count is out of range")
    if not (0 <= header.pinned <= header.splats and -1 <= header.sh_degree <= 3):
        raise ValueError("a count is out of range")
    if not isinstance(header.columns, dict) or not isinstance(header.dropped, dict):
        raise ValueError("the columns, or what was left out, are no table")
    if not all(type(value) is int for value in header.dropped.values()):
        raise ValueError("the numbers of what was left out are no whole numbers")
    if not all(isinstance(text, str) for text in (header.identity, *header.sources)):
        raise ValueError("a name is no text")
    if (
        len(header.origin) != 3
        or not np.isfinite(header.origin).all()
        or np.abs(header.origin).max() > LARGEST
    ):
        raise ValueError("the origin is no point")
    types = _TYPES | {"colors" if header.sh_degree < 0 else "sh": ("<f2", "<f4")}
    for name, kind in header.columns.items():
        if kind not in types.get(name, ()):
            raise ValueError(f"the column {name} of the type {kind}")
    # all but three columns are in every store
    if missing := types.keys() - {"labels", "planes", "thickness"} - header.columns.keys():
        raise ValueError(f"no column {min(missing)}")
    if header.ellipsoids not in ("none", "some", "all"):
        raise ValueError("its 3D Gaussians are neither none nor some nor all")
    if header.ellipsoids != "none" and "thickness" not in header.columns:
        raise ValueError("3D Gaussians have a column thickness")
    if not isinstance(header.store, (str, type(None))):
        raise ValueError("the store that is placed has no name")


def column_shapes(header: Header) -> dict[str, tuple[int, ...]]:
    """Shape of a splat's part of each array that a store may have."""
    return shapes_of(header.sh_degree)


def shapes_of(sh_degree: int) -> dict[str, tuple[int, ...]]:
    """As `column_shapes`."""
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "quats": (4,), "scales": (2,), "opacities": ()}
    shapes |= {"labels": (), "planes": (), "thickness": ()}
    return shapes | ({"colors": (3,)} if sh_degree < 0 else {"sh": ((sh_degree + 1) ** 2, 3)})


def npy_header(kind: str, shape: tuple[int, ...]) -> bytes:
    """The header of a .npy file, always as long: it is written before anybody knows how many rows follow."""
    text = f"{{'descr': '{np.dtype(kind).str}', 'fortran_order': False, 'shape': {shape!r}, }}"
    body = text.encode("ascii").ljust(NPY_HEADER - 11) + b"\n"
    return b"\x93NUMPY\x01\x00" + (NPY_HEADER - 10).to_bytes(2, "little") + body


def column_file(folder: Path, name: str) -> Path:
    """Where a column lies."""
    return folder / f"{name}.npy"


def row_bytes(kind: str, shape: tuple[int, ...]) -> int:
    """Bytes of a splat's part of a column."""
    return np.dtype(kind).itemsize * int(np.prod(shape, dtype=np.int64))


def checksum(parts: Mapping[str, np.ndarray]) -> int:
    """CRC-32 of a chunk: of its arrays as they are stored, in the order of the header's columns."""
    crc = 0
    for array in parts.values():
        crc = zlib.crc32(np.ascontiguousarray(array).view(np.uint8).reshape(-1).data, crc)
    return crc


def map_column(folder: Path, name: str, kind: str, shape: tuple[int, ...], starts: np.ndarray) -> np.ndarray:
    """A column (rows, ...) as it lies in its file, mapped and read-only. starts: (n,) the nodes' first rows.

    Raises InputError where the file is missing, or shorter or of another kind than the header says.
    """
    file, wanted = column_file(folder, name), npy_header(kind, shape)
    size = NPY_HEADER + row_bytes(kind, shape[1:]) * shape[0]
    try:
        with open_input(file) as stream:
            begins, found = stream.read(NPY_HEADER), os.fstat(stream.fileno()).st_size
    except InputError as error:
        raise InputError(f"{error}; the store is not whole") from error
    if found < size:
        lost = max(found - NPY_HEADER, 0) // max(row_bytes(kind, shape[1:]), 1)
        chunk = max(int(np.searchsorted(starts, lost, "right")) - 1, 0)
        raise InputError(
            f"{file} is cut short: it has {found} bytes of {size}, so that rows from {lost} on are missing, "
            f"of chunk {chunk} and of all after it; build the store again"
        )
    if begins != wanted or found > size:
        raise InputError(f"{file} is not of this store, or its header is damaged; build the store again")
    if not shape[0]:
        return np.empty(shape, kind)
    return np.memmap(file, kind, "r", NPY_HEADER, shape).view(np.ndarray)


def write_nodes(folder: Path, nodes: np.ndarray) -> int:
    """Write the index; returns the CRC-32 of its records."""
    with atomic_write(folder / NODES) as stream:
        np.save(stream, nodes)
    return zlib.crc32(nodes.tobytes())


def read_nodes(folder: Path, header: Header) -> np.ndarray:
    """The index, (n,) of `NODE`. Raises InputError where it is missing, damaged or unlike its header."""
    file = folder / NODES
    try:
        nodes = load_npy(file)
    except InputError as error:
        raise InputError(f"{error}; the store is not whole") from error
    except ValueError:
        nodes = np.empty(0)
    if nodes.dtype != NODE or nodes.ndim != 1 or zlib.crc32(nodes.tobytes()) != header.nodes_crc:
        raise InputError(f"{file} is damaged: its checksum is another; build the store again")
    if wrong := _misfit(nodes, header):
        raise InputError(f"{file} does not fit {HEADER}: {wrong}; build the store again")
    return nodes


def _misfit(nodes: np.ndarray, header: Header) -> str:
    """How an index differs from one that was built with its header; empty where it does not. Whoever renders
    a store relies on every line of this."""
    first, count, level, parent = (
        nodes[name].astype(np.int64) for name in ("first", "count", "level", "parent")
    )
    chunk, ends = level == 0, np.cumsum(count)
    if (count < 1).any() or (count[chunk] > header.chunk).any():
        return f"a node must have 1 to {header.chunk} splats"
    if ends.max(initial=0) != header.rows or (first != ends - count).any():
        return f"its nodes must be {header.rows} rows, one after the other"
    if not np.isin(np.diff(level, prepend=0), (0, 1)).all():
        return "levels must rise from 0, one by one"
    if count[chunk].sum() != header.splats:
        return f"its chunks must have {header.splats} splats"
    if header.pinned not in {*first[chunk].tolist(), header.splats}:
        return "splats on planes must begin with a chunk"
    above = np.flatnonzero(parent != -1)
    if not ((parent >= -1) & (parent < len(nodes))).all() or (level[parent[above]] != level[above] + 1).any():
        return "a node's parent must be of the level above"
    if (parent[chunk & (first >= header.pinned)] != -1).any():
        return "splats on planes must have no parent"
    lengths = ("size", "reach", "low", "high", "far_low", "far_high")
    if not all(np.isfinite(nodes[name]).all() for name in lengths):
        return "sizes and boxes must be finite"
    if (nodes["size"] < 0).any() or (nodes["size"][chunk] != 0).any() or (nodes["reach"] < 0).any():
        return "sizes must be at least 0, and 0 for chunks"
    corners = [nodes[name] for name in ("far_low", "low", "high", "far_high")]
    if any((a > b).any() for a, b in pairwise(corners)):
        return "a box must lie within the larger one of its node"
    return ""
