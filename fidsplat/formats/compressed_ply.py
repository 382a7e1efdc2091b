"""Reading of SuperSplat's compressed PLY, as the PlayCanvas editor and splat-transform write it.

Each 256 splats share a row of the element chunk: minimum and maximum of position, log scale and (in newer
files) colour. The element vertex has four 32-bit words per splat:

    packed_position, packed_scale   11, 10, 11 bits x, y, z from the top, in [min, max] of the chunk
    packed_rotation                 2 bits: index of the largest of w, x, y, z (omitted, positive);
                                    3 x 10 bits: the others in that order, in [-1, 1] / sqrt(2)
    packed_color                    8 bits each of r, g, b (in [min, max] of the chunk, or [0, 1]) and opacity

An element sh contains the degrees above 0, one byte per coefficient in [-4, 4], in the order of f_rest.
"""

import numpy as np

from fidsplat.formats.collect import BLOCK, Rows
from fidsplat.formats.ply_header import Header
from fidsplat.splats.harmonics import C0
from fidsplat.splats.rotations import with_largest_component
from fidsplat.util.errors import InputError

CHUNK = 256
_CHUNKS_AT_ONCE = BLOCK // CHUNK
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")


def is_compressed(header: Header) -> bool:
    """Whether a header declares a compressed PLY, which `compressed_rows` validates."""
    vertex = header.elements.get("vertex")
    return vertex is not None and any(name in vertex.properties for name in _PACKED)


def compressed_rows(header: Header) -> Rows:
    """Rows of a compressed PLY: three scales, all arrays float32.

    Raises InputError for an element or property that is missing or has the wrong type or length.
    """
    n = header.elements["vertex"].count
    _check(header, "vertex", _PACKED, "<u4", n)
    limits = [f"{end}_{part}{axis}" for part in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
    color_limits = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
    _check(header, "chunk", limits, "<f4", -(-n // CHUNK))
    colored = any(name in header.elements["chunk"].properties for name in color_limits)
    if colored:
        _check(header, "chunk", color_limits, "<f4", -(-n // CHUNK))
    rest = len(header.elements["sh"].properties) if "sh" in header.elements else 0
    if rest:
        _check(header, "sh", [f"f_rest_{i}" for i in range(rest)], "|u1", n)
        if rest not in (9, 24, 45):
            raise InputError(f"{header.path}: the element sh must have 9, 24 or 45 properties, got {rest}")

    columns = {
        "means": ((3,), np.float32),
        "quats": ((4,), np.float32),
        "scales": ((3,), np.float32),
        "opacities": ((), np.float32),
        "sh": ((rest // 3 + 1, 3), np.float32),
    }

    def fill(first: int, arrays: dict[str, np.ndarray]) -> None:
        end = first + len(arrays["means"])
        rows, chunks = (
            header.rows("vertex", first, end),
            header.rows("chunk", first // CHUNK, -(-end // CHUNK)),
        )
        bands = header.rows("sh", first, end) if rest else None
        for start in range(0, len(rows), BLOCK):  # blocks bound the size of float64 temporaries
            part = slice(start, start + BLOCK)
            owners = chunks[start // CHUNK : start // CHUNK + _CHUNKS_AT_ONCE]
            unpacked = _unpack(rows[part], owners, colored)
            arrays["sh"][part, 0] = unpacked.pop("dc")
            for name, values in unpacked.items():
                arrays[name][part] = values
            if bands is not None:
                arrays["sh"][part, 1:] = _bands(bands[part], rest)

    return Rows(header.path, n, columns, fill)


def _unpack(rows: np.ndarray, chunks: np.ndarray, colored: bool) -> dict[str, np.ndarray]:
    """Decode splats of chunks to float64: means, quats, scales, opacities, and SH of degree 0, dc (k, 3)."""
    chunk_of = np.arange(len(rows)) // CHUNK

    def end(which: str, axes: str) -> np.ndarray:
        return np.stack([chunks[f"{which}_{axis}"] for axis in axes], axis=1)[chunk_of]

    def between(part: str, axes: str, t: np.ndarray) -> np.ndarray:
        return end(f"min{part}", axes) * (1 - t) + end(f"max{part}", axes) * t

    position, scale = (_unit_fractions(rows[f"packed_{name}"], 11, 10, 11) for name in ("position", "scale"))
    color = _unit_fractions(rows["packed_color"], 8, 8, 8, 8)
    rotations = rows["packed_rotation"]
    three = (_unit_fractions(rotations, 10, 10, 10) - 0.5) * np.sqrt(2.0)
    return {
        "means": between("", "xyz", position),
        "quats": with_largest_component(three, rotations >> 30),
        "scales": np.exp(between("_scale", "xyz", scale)),
        "opacities": color[:, 3],
        "dc": ((between("", "rgb", color[:, :3]) if colored else color[:, :3]) - 0.5) / C0,
    }


def _check(header: Header, name: str, properties, kind: str, count: int) -> None:
    element = header.elements.get(name)
    if element is None:
        raise InputError(f"{header.path}: a compressed PLY must have the element {name}, got none")
    missing = [p for p in properties if p not in element.properties]
    if missing:
        raise InputError(
            f"{header.path}: the element {name} of a compressed PLY must have {', '.join(missing)}, got "
            f"{', '.join(element.properties) or 'no properties'}"
        )
    wrong = [p for p in properties if element.dtype[p] != np.dtype(kind)]
    if wrong:
        raise InputError(
            f"{header.path}: {', '.join(wrong)} of the element {name} must have the type {kind} in a "
            f"compressed PLY, got {element.dtype[wrong[0]].str}"
        )
    if element.count != count:
        raise InputError(
            f"{header.path}: a compressed PLY must have {count} rows of {name}, got {element.count}"
        )


def _unit_fractions(words: np.ndarray, *widths: int) -> np.ndarray:
    """Decode bit fields of words (n,), the highest field first, to (n, len(widths)) float64 in [0, 1]."""
    columns, shift = [], sum(widths)
    for width in widths:
        shift -= width
        mask = (1 << width) - 1
        columns.append(((words >> shift) & mask) / mask)
    return np.stack(columns, axis=1)


def _bands(rows: np.ndarray, rest: int) -> np.ndarray:
    """Decode SH bytes to (n, rest / 3, 3) float32: centres of 256 bins over [-4, 4]; 0 and 255 are the
    ends."""
    fraction = (np.arange(256) + 0.5) / 256
    fraction[[0, 255]] = 0.0, 1.0
    value = ((fraction - 0.5) * 8).astype(np.float32)
    table = np.stack([rows[f"f_rest_{i}"] for i in range(rest)], axis=1)
    return value[table].reshape(len(rows), 3, rest // 3).transpose(0, 2, 1)
