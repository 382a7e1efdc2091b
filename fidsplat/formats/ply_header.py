"""Header of a binary little-endian PLY file: written, or validated against the file size before data is
mapped."""

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path

import numpy as np

from fidsplat.util.errors import InputError
from fidsplat.util.files import open_input, path_of

MAX_HEADER = 65536
"""maximum size of a header in bytes; a splat file's has about 2,000"""

_TYPES = {
    "char": "<i1",
    "uchar": "<u1",
    "short": "<i2",
    "ushort": "<u2",
    "int": "<i4",
    "uint": "<u4",
    "float": "<f4",
    "double": "<f8",
    "int8": "<i1",
    "uint8": "<u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "float32": "<f4",
    "float64": "<f8",
}


_TYPE_NAMES = {kind[1:]: name for name, kind in reversed(_TYPES.items())}
"""names of types that all programs read, by code of NumPy"""


def header_bytes(*elements: tuple[str, int, Mapping[str, str]], comments: Sequence[str] = ()) -> bytes:
    """Header of a binary little-endian PLY file.

    elements: name, number of rows, and types of the properties by name: codes of NumPy such as f4 and u1, or
    "list TYPE TYPE".
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    for name, count, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {_TYPE_NAMES.get(kind, kind)} {key}" for key, kind in properties.items()]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


@dataclass(frozen=True)
class Element:
    """Table of a PLY file: `count` rows of `dtype` (packed, fields in file order) from byte `offset`."""

    name: str
    count: int
    dtype: np.dtype
    offset: int

    @property
    def properties(self) -> tuple[str, ...]:
        return self.dtype.names or ()


@dataclass(frozen=True)
class Header:
    """Elements and comments of a PLY file."""

    path: Path
    elements: dict[str, Element]
    comments: tuple[str, ...]
    text: bool = False
    """whether rows are text; the offset of all elements is then the offset of the first one"""

    def rows(self, name: str, first: int, end: int) -> np.ndarray:
        """Rows [first, end) of an element as a read-only structured array, memory-mapped for binary files.

        Raises InputError for a damaged text file.
        """
        element = self.elements[name]
        if end <= first:
            return np.zeros(0, element.dtype)
        if self.text:
            return self._text_rows(element)[first:end]
        offset = element.offset + first * element.dtype.itemsize
        mapped = np.memmap(self.path, element.dtype, "r", offset, (end - first,))
        return mapped.view(np.ndarray)  # indexing a memmap is several times slower than an array

    def _text_rows(self, element: Element) -> np.ndarray:
        before = 0
        for other in takewhile(lambda other: other is not element, self.elements.values()):
            before += other.count
        try:
            with open_input(self.path) as stream:
                stream.seek(element.offset)
                lines = islice(stream, before, before + element.count)
                rows = np.loadtxt(lines, element.dtype, comments=None, ndmin=1)
        except (OSError, ValueError) as error:
            raise InputError(f"{self.path}: rows of {element.name} are damaged: {error}") from error
        if len(rows) != element.count:
            raise InputError(
                f"{self.path}: truncated: its header declares {element.count} rows of {element.name}, but "
                f"the file has {len(rows)}"
            )
        return rows


def read_header(path: str | os.PathLike[str], text: bool = False) -> Header:
    """Read and validate the header of a PLY file.

    text: accept ASCII files.

    Raises InputError for a file that cannot be read, is not binary little-endian PLY, is shorter than its
    header declares, or whose header is damaged, longer than 64 KiB or has a list property. Warns if the file
    is longer.
    """
    file = path_of(path)
    head, size = _beginning(file)
    lines, start = _lines(file, head)
    counts: dict[str, int] = {}
    fields: dict[str, list[tuple[str, str]]] = {}
    comments, layout, current = [], None, None
    for line in lines:
        words = line.split()
        keyword = words[0] if words else "comment"
        if keyword in ("comment", "obj_info"):
            comments.append(line.partition(" ")[2].strip())
        elif keyword == "format":
            layout = " ".join(words[1:])
        elif keyword == "element":
            if len(words) != 3 or words[1] in counts:
                raise InputError(f"{file}: a line of a PLY header must name a new element, got {line!r}")
            current = words[1]
            counts[current], fields[current] = _count(file, line, words[2]), []
        elif keyword == "property":
            if current is None:
                raise InputError(f"{file}: a PLY header must name an element before the property {words[-1]}")
            fields[current].append(_field(file, line, words, fields[current]))
        else:
            raise InputError(f"{file}: a line of a PLY header must be a known keyword, got {line[:60]!r}")
    if text and layout == "ascii 1.0":
        dtypes = {name: np.dtype(fields[name]) for name in counts}
        elements = {name: Element(name, counts[name], dtypes[name], start) for name in counts}
        return Header(file, elements, tuple(comments), True)
    if layout != "binary_little_endian 1.0":
        raise InputError(
            f"{file}: the PLY format must be binary_little_endian 1.0, got {layout}; convert it by plyfile: "
            "PlyData(PlyData.read(IN).elements, byte_order='<').write(OUT)"
        )
    elements, offset = {}, start
    for name, count in counts.items():
        elements[name] = Element(name, count, np.dtype(fields[name]), offset)
        offset += count * elements[name].dtype.itemsize
    if size < offset:
        raise InputError(f"{file}: truncated: its header declares {offset} bytes, but the file has {size}")
    if size > offset:
        warnings.warn(f"{file}: {size - offset} bytes after the PLY data are not read", stacklevel=3)
    return Header(file, elements, tuple(comments))


def _beginning(file: Path) -> tuple[bytes, int]:
    with open_input(file) as stream:
        return stream.read(MAX_HEADER), os.fstat(stream.fileno()).st_size


def _lines(file: Path, head: bytes) -> tuple[list[str], int]:
    """Header lines between `ply` and `end_header`, and the offset of the data in bytes."""
    if not head:
        raise InputError(f"cannot read {file} as PLY: it is empty")
    if not re.match(rb"ply\r?\n", head):
        raise InputError(f"cannot read {file} as PLY: its first line must be 'ply'")
    end = re.search(rb"\nend_header\r?\n", head)
    if end is None:
        raise InputError(f"{file}: a PLY header must have end_header within {MAX_HEADER} bytes, got none")
    try:
        text = head[: end.start()].decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{file}: the PLY header must be text, got other bytes") from None
    return text.replace("\r", "").split("\n")[1:], end.end()


def _count(file: Path, line: str, word: str) -> int:
    if not re.fullmatch(r"[0-9]{1,18}", word):
        raise InputError(f"{file}: a count in the PLY header must be a whole number >= 0, got {line[:60]!r}")
    return int(word)


def _field(file: Path, line: str, words: list[str], before: list[tuple[str, str]]) -> tuple[str, str]:
    if len(words) > 1 and words[1] == "list":
        raise InputError(f"{file}: properties of the PLY header must be scalars, got the list {line[:60]!r}")
    if len(words) != 3 or words[1] not in _TYPES:
        raise InputError(
            f"{file}: a property of a PLY header must be 'property TYPE NAME' of a known type, got "
            f"{line[:60]!r}"
        )
    if any(words[2] == name for name, _ in before):
        raise InputError(f"{file}: properties of an element of a PLY header must differ, got two {words[2]}")
    return words[2], _TYPES[words[1]]
