"""Writing of point clouds with named fields as PCD, PLY and NumPy files."""

from __future__ import annotations

import os

import numpy as np

from fidsplat.util.arguments import invalid
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write, path_of

ENDINGS = (".pcd", ".ply", ".npy")
_PLY_TYPES = {
    **{"f4": "float", "f8": "double", "u1": "uchar", "i1": "char", "u2": "ushort", "i2": "short"},
    **{"u4": "uint", "i4": "int"},
}


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
        if code not in _PLY_TYPES:
            raise InputError(
                f"fields of points must be numbers of 1 to 4 bytes or float64, got {name} {code}"
            )
    kind = path_of(path).suffix.lower()
    with atomic_write(path) as file:
        if kind == ".npy":
            np.save(file, points)
            return
        file.write(
            (_pcd_header if kind == ".pcd" else _ply_header)(names, codes, len(points)).encode("ascii")
        )
        file.write(points.astype(little).tobytes())


def _pcd_header(names: tuple[str, ...], codes: list[str], count: int) -> str:
    kinds = [code[0].upper() for code in codes]
    lines = (
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(names)}",
        f"SIZE {' '.join(code[1:] for code in codes)}",
        f"TYPE {' '.join(kinds)}",
        f"COUNT {' '.join('1' for _ in names)}",
        f"WIDTH {count}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {count}",
        "DATA binary",
    )
    return "\n".join(lines) + "\n"


def _ply_header(names: tuple[str, ...], codes: list[str], count: int) -> str:
    fields = (f"property {_PLY_TYPES[code]} {name}" for name, code in zip(names, codes, strict=True))
    lines = ("ply", "format binary_little_endian 1.0", f"element vertex {count}", *fields, "end_header")
    return "\n".join(lines) + "\n"
