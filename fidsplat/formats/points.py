"""Writing of point clouds with named fields as PCD, PLY and NumPy files."""

from __future__ import annotations

import os

import numpy as np

from fidsplat.formats.ply_header import header_bytes
from fidsplat.util.arguments import invalid
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, path_of

ENDINGS = (".pcd", ".ply", ".npy")
_TYPES = ("f4", "f8", "u1", "i1", "u2", "i2", "u4", "i4")
"""codes of NumPy for types of fields"""


def check_points_file(path: str | os.PathLike[str]) -> None:
    """Raise InputError for a suffix other than .pcd, .ply or .npy."""
    if path_of(path).suffix.lower() not in ENDINGS:
        raise InputError(f"the suffix of a file of points must be {', '.join(ENDINGS)}, got {path}")


def save_points(points: np.ndarray, path: str | os.PathLike[str]) -> None:
    """Write a structured array with one record per point: binary PCD 0.7 or little-endian PLY, or .npy.

    Raises:
        InputError: points are not a structured array of numbers, or the file cannot be written.
    """
    check_points_file(path)
    names = getattr(points, "dtype", np.dtype(float)).names
    if not isinstance(points, np.ndarray) or names is None or points.ndim != 1:
        raise invalid("points", "a structured array (n,)", points)
    little = np.dtype([(name, points.dtype[name].newbyteorder("<")) for name in names])
    codes = [little[name].str[1:] for name in names]
    for name, code in zip(names, codes, strict=True):
        if code not in _TYPES:
            raise InputError(
                f"fields of points must be numbers of 1 to 4 bytes or float64, got {name} {code}"
            )
    kind = path_of(path).suffix.lower()
    with atomic_write(path) as file:
        if kind == ".npy":
            np.save(file, points)
            return
        fields = dict(zip(names, codes, strict=True))
        vertex = ("vertex", len(points), fields)
        file.write(_pcd_header(fields, len(points)) if kind == ".pcd" else header_bytes(vertex))
        file.write(points.astype(little).tobytes())


def _pcd_header(fields: dict[str, str], count: int) -> bytes:
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(fields)}",
        f"SIZE {' '.join(code[1:] for code in fields.values())}",
        f"TYPE {' '.join(code[0].upper() for code in fields.values())}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    )
    return ("\n".join(lines) + "\n").encode("ascii")
