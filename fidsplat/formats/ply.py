"""Reading of splats from PLY files of all layouts."""

import os
import warnings

import numpy as np

from fidsplat.formats.collect import BLOCK, Progress, Rows, collect
from fidsplat.formats.compressed_ply import compressed_rows, is_compressed
from fidsplat.formats.ply_header import Element, Header, read_header
from fidsplat.splats.arrays import drop_report
from fidsplat.splats.cloud import SplatCloud
from fidsplat.util.errors import InputError

ORIGIN_COMMENT = "fidsplat origin"
"""prefix of the header comment with the three coordinates of the origin"""

FILTER = "filter_3D"
"""property with the standard deviation [m] of Mip-Splatting's 3D smoothing filter"""

_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1")
_NEEDED += ("rot_0", "rot_1", "rot_2", "rot_3")


def load_ply(path: str | os.PathLike[str], progress: Progress | None = None) -> SplatCloud:
    """Read a splat file: 2DGS layout (two scales), 3DGS layout (three), or SuperSplat's compressed PLY.

    Properties may have any order; unknown ones are ignored. Splats of three scales are 3D Gaussians
    (`SplatCloud.thickness`; `SplatCloud.flattened` makes them disks), except that a third scale of 1e-6 marks
    a disk. The 3D filter of Mip-Splatting's files (`filter_3D`) is applied, as the trainer rendered them
    (`Quality.ellipsoid="ewa_antialiased"`). Integer properties `label` and `plane` become labels and coplanar
    groups. Colours are SH of degree 0 to 3. Invalid splats are dropped with one warning.

    progress: callback of the current task and its completed share, 0 to 1.

    Raises InputError for a file that is missing, damaged, not PLY, or lacks a property.
    """
    rows, origin = ply_rows(path)
    arrays, dropped = collect(rows, progress)
    if dropped:
        warnings.warn(drop_report(dropped, rows.count, rows.path), stacklevel=2)
    groups = arrays.pop("coplanar_groups", None)
    cloud = SplatCloud.of_checked(**arrays, origin=origin, dropped=dropped)
    return cloud if groups is None else cloud.with_coplanar_groups(groups)


def ply_rows(path: str | os.PathLike[str]) -> tuple[Rows, np.ndarray | None]:
    """The rows of a splat file, for reading in parts, and its optional origin (3,) float64.

    Raises InputError for a file that is missing, damaged, not PLY, or lacks a property.
    """
    header = read_header(path)
    origin = _origin(header)
    return compressed_rows(header) if is_compressed(header) else _plain_rows(header), origin


def _plain_rows(header: Header) -> Rows:
    element = header.elements.get("vertex")
    if element is None:
        raise InputError(f"{header.path}: the PLY file has no element vertex")
    k = (_check_properties(header, element) + 1) ** 2
    names = element.properties
    wide = any(element.dtype[axis].itemsize == 8 for axis in "xyz")
    scales = 3 if "scale_2" in names else 2
    columns = {
        "means": ((3,), np.float64 if wide else np.float32),
        "quats": ((4,), np.float32),
        "scales": ((scales,), np.float32),
        "opacities": ((), np.float32),
        "sh": ((k, 3), np.float32),
    }
    # target of each property: name of an array and index
    places: dict[str, tuple] = {axis: ("means", slice(None), i) for i, axis in enumerate("xyz")}
    places |= {f"rot_{i}": ("quats", slice(None), i) for i in range(4)}
    places |= {f"scale_{i}": ("scales", slice(None), i) for i in range(scales)}
    places["opacity"] = ("opacities",)
    places |= {f"f_dc_{c}": ("sh", slice(None), 0, c) for c in range(3)}
    # the file has all higher bands of red, then of green, then of blue
    places |= {
        f"f_rest_{c * (k - 1) + i}": ("sh", slice(None), 1 + i, c) for c in range(3) for i in range(k - 1)
    }
    filtered = scales == 3 and FILTER in names and element.dtype[FILTER].kind == "f"
    for name, array in (("label", "labels"), ("plane", "coplanar_groups")):
        if name in names and np.can_cast(element.dtype[name], np.int32):
            columns[array], places[name] = ((), np.int32), (array,)

    def fill(first: int, arrays: dict[str, np.ndarray]) -> None:
        rows = header.rows("vertex", first, first + len(arrays["means"]))
        for start in range(0, len(rows), BLOCK):
            block = rows[start : start + BLOCK]
            for name, (array, *index) in places.items():
                arrays[array][start : start + BLOCK][*index] = block[name]
        np.exp(arrays["scales"], out=arrays["scales"])
        _sigmoid(arrays["opacities"])
        if filtered:
            _widen(arrays["scales"], arrays["opacities"], rows[FILTER])
        if "coplanar_groups" in arrays and (lowest := arrays["coplanar_groups"].min(initial=-1)) < -1:
            raise InputError(
                f"{header.path}: the property plane must be an id of 0 or more, or -1 for a splat without a "
                f"group, got {lowest}"
            )

    return Rows(header.path, element.count, columns, fill)


def _check_properties(header: Header, element: Element) -> int:
    """Check the properties of the vertex element; returns the SH degree."""
    names = element.properties
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(f"{header.path}: not a splat file: the element vertex lacks {', '.join(missing)}")
    rest = [name for name in names if name.startswith("f_rest_")]
    if len(rest) not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(len(rest))):
        raise InputError(
            f"{header.path}: the element vertex has {len(rest)} properties f_rest_*; "
            "SH of degree 0, 1, 2, 3 has 0, 9, 24, 45, numbered from 0"
        )
    used = [name for name in (*_NEEDED, "scale_2", *rest) if name in names]
    wrong = [name for name in used if element.dtype[name].kind != "f"]
    if wrong:
        got = ", ".join(f"{name} of {element.dtype[name]}" for name in wrong)
        raise InputError(f"{header.path}: properties of splats must be float or double, got {got}")
    return int(np.sqrt(len(rest) // 3 + 1)) - 1


def _sigmoid(x: np.ndarray) -> None:
    """Sigmoid in place; exactly 0 and 1 for -inf and inf."""
    np.negative(x, out=x)
    np.exp(x, out=x)
    x += 1
    np.reciprocal(x, out=x)


def _widen(scales: np.ndarray, opacities: np.ndarray, filters: np.ndarray) -> None:
    """Apply the 3D smoothing filter of Mip-Splatting (Yu et al. 2024) in place.

    Gaussians of scales (n, 3) are convolved with isotropic ones of standard deviations (n,); opacities (n,)
    decrease with the density.
    """
    wide = np.hypot(scales.astype(np.float64), filters[:, None])
    opacities *= np.divide(scales, wide, out=np.ones_like(wide), where=wide > 0).prod(axis=1)
    scales[:] = wide


def _origin(header: Header) -> np.ndarray | None:
    for comment in header.comments:
        if comment.startswith(ORIGIN_COMMENT):
            try:
                origin = np.array([float(word) for word in comment[len(ORIGIN_COMMENT) :].split()])
            except ValueError:
                origin = np.empty(0)
            if origin.shape != (3,) or not np.isfinite(origin).all():
                raise InputError(
                    f"{header.path}: the comment of the origin must have three finite numbers, got "
                    f"{comment!r}"
                )
            return origin
    return None
