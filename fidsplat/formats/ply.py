"""Reading and writing of splats as PLY files of all layouts."""

import os
import warnings

import numpy as np

from fidsplat.formats.collect import BLOCK, PADDED_LOG_SCALE, Rows, collect
from fidsplat.formats.compressed_ply import compressed_rows, is_compressed
from fidsplat.formats.plain import refuse_boxes
from fidsplat.formats.ply_header import Element, Header, header_bytes, read_header
from fidsplat.splats.arrays import drop_report
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util.arguments import flag, instance
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write
from fidsplat.util.progress import Progress

ORIGIN_COMMENT = "fidsplat origin"
"""prefix of the header comment with the three coordinates of the origin"""

FILTER = "filter_3D"
"""property with the standard deviation [m] of Mip-Splatting's 3D smoothing filter"""

_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1")
_NEEDED += ("rot_0", "rot_1", "rot_2", "rot_3")


def load_ply(path: str | os.PathLike[str], progress: Progress | None = None) -> SplatCloud:
    """Read a PLY file: 2DGS layout (two scales), 3DGS layout (three), or SuperSplat's compressed PLY.

    Properties may have any order; unknown properties are ignored. Splats with three scales are 3D Gaussians
    (`SplatCloud.thickness`; `SplatCloud.flattened` makes them disks), unless the third scale is 1e-6, which
    marks a disk. The 3D filter of Mip-Splatting (`filter_3D`) is applied, as its trainer rendered
    (`Quality.ellipsoid="ewa_antialiased"`). Integer properties `label` and `plane` become labels and coplanar
    groups. Colours are SH of degree 0 to 3. Invalid splats are dropped with one warning.

    progress: callback with the current task and its completed fraction, 0 to 1.

    Raises InputError for a file that is missing, damaged, not PLY, or without a required property.
    """
    rows, origin = ply_rows(path)
    arrays, dropped = collect(rows, progress)
    if dropped:
        warnings.warn(drop_report(dropped, rows.count, rows.path), stacklevel=2)
    groups = arrays.pop("coplanar_groups", None)
    cloud = SplatCloud.from_validated(**arrays, origin=origin, dropped=dropped)
    return cloud if groups is None else cloud.with_coplanar_groups(groups)


def ply_rows(path: str | os.PathLike[str]) -> tuple[Rows, np.ndarray | None]:
    """Rows of a PLY file, which can be read in windows, and its optional origin (3,) float64.

    Raises InputError for a file that is missing, damaged, not PLY, or without a required property.
    """
    header = read_header(path)
    origin = _origin(header)
    return compressed_rows(header) if is_compressed(header) else _plain_rows(header), origin


def _plain_rows(header: Header) -> Rows:
    element = header.elements.get("vertex")
    if element is None:
        raise InputError(f"{header.path}: a PLY file of splats must have the element vertex, got none")
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
    # array and index of each property
    targets: dict[str, tuple] = {axis: ("means", slice(None), i) for i, axis in enumerate("xyz")}
    targets |= {f"rot_{i}": ("quats", slice(None), i) for i in range(4)}
    targets |= {f"scale_{i}": ("scales", slice(None), i) for i in range(scales)}
    targets["opacity"] = ("opacities",)
    targets |= {f"f_dc_{c}": ("sh", slice(None), 0, c) for c in range(3)}
    # f_rest has all degrees above 0 of red, then of green, then of blue
    targets |= {
        f"f_rest_{c * (k - 1) + i}": ("sh", slice(None), 1 + i, c) for c in range(3) for i in range(k - 1)
    }
    filtered = scales == 3 and FILTER in names and element.dtype[FILTER].kind == "f"
    for name, array in (("label", "labels"), ("plane", "coplanar_groups")):
        if name in names and np.can_cast(element.dtype[name], np.int32):
            columns[array], targets[name] = ((), np.int32), (array,)

    def fill(first: int, arrays: dict[str, np.ndarray]) -> None:
        rows = header.rows("vertex", first, first + len(arrays["means"]))
        for start in range(0, len(rows), BLOCK):
            block = rows[start : start + BLOCK]
            for name, (array, *index) in targets.items():
                arrays[array][start : start + BLOCK][*index] = block[name]
        np.exp(arrays["scales"], out=arrays["scales"])
        _sigmoid(arrays["opacities"])
        if filtered:
            _widen(arrays["scales"], arrays["opacities"], rows[FILTER])
        if "coplanar_groups" in arrays and (lowest := arrays["coplanar_groups"].min(initial=-1)) < -1:
            raise InputError(
                f"{header.path}: the property 'plane' (coplanar group) must be an id of 0 or more, or -1 "
                f"for none, got {lowest}; correct it, or remove the property"
            )

    return Rows(header.path, element.count, columns, fill)


def _check_properties(header: Header, element: Element) -> int:
    """Validate the properties of the vertex element; returns the SH degree."""
    names = element.properties
    missing = [name for name in _NEEDED if name not in names]
    if missing:
        raise InputError(
            f"{header.path}: the element vertex of a PLY file of splats must have {', '.join(missing)}, got "
            "none of them"
        )
    rest = [name for name in names if name.startswith("f_rest_")]
    if len(rest) not in (0, 9, 24, 45) or any(f"f_rest_{i}" not in names for i in range(len(rest))):
        raise InputError(
            f"{header.path}: the element vertex must have 0, 9, 24 or 45 properties f_rest_*, numbered from "
            f"0, for SH of degree 0 to 3, got {len(rest)}"
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

    Gaussians with scales (n, 3) are convolved with isotropic Gaussians of standard deviations (n,); opacities
    (n,) decrease with the density.
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


_BLOCK = 65536
MAX_LOGIT = 100.0
"""logit that stands for opacity 1 (and -100 for 0): its sigmoid is 1 in float32"""


def save_ply(cloud: SplatCloud, path: str | os.PathLike[str], native_2dgs: bool = False) -> None:
    """Write binary little-endian PLY, all float32: x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*.

    The third scale is the thickness of a 3D Gaussian, and log(1e-6) for a disk, so that 3DGS tools open the
    file; `native_2dgs` omits it. Plain colours become SH of degree 0. Integer properties are added for labels
    other than 0 (label) and coplanar groups (plane). If the origin is not 0, a comment contains it, and x, y,
    z are relative to it.

    Raises InputError for a file that cannot be written, boxes, or 3D Gaussians with `native_2dgs`; an
    existing file is then unchanged.
    """
    refuse_boxes(instance("cloud", cloud, SplatCloud), "a PLY file")
    if flag("native_2dgs", native_2dgs) and cloud.thickness is not None:
        raise InputError(
            "splats must be disks for native_2dgs, got "
            f"{int((cloud.thickness > 0).sum())} 3D Gaussians of {len(cloud)}; use native_2dgs=False, or "
            "flatten them by cloud.flattened()"
        )
    rest = 0 if cloud.sh is None else 3 * (cloud.sh.shape[1] - 1)
    names = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", "scale_0", "scale_1", *([] if native_2dgs else ["scale_2"])]
    names += [f"rot_{i}" for i in range(4)]
    integers = {"label": cloud.labels} if cloud.labels.any() else {}
    if cloud.coplanar_groups is not None:
        integers["plane"] = cloud.coplanar_groups
    column = {name: i for i, name in enumerate(names)}
    origin = f"{ORIGIN_COMMENT} {' '.join(repr(float(v)) for v in cloud.origin)}"
    properties = dict.fromkeys(names, "f4") | dict.fromkeys(integers, "i4")
    header = header_bytes(("vertex", len(cloud), properties), comments=[origin] if cloud.origin.any() else [])
    with atomic_write(path) as stream:
        stream.write(header)
        for start in range(0, len(cloud), _BLOCK):
            part = slice(start, start + _BLOCK)
            n = len(cloud.means[part])
            rows = np.zeros((n, len(names) + len(integers)), "<f4")
            rows[:, 0:3] = cloud.means[part]
            dc = column["f_dc_0"]
            if cloud.sh is not None:
                rows[:, dc : dc + 3] = cloud.sh[part, 0]
                rows[:, dc + 3 : dc + 3 + rest] = cloud.sh[part, 1:].transpose(0, 2, 1).reshape(n, rest)
            elif cloud.colors is not None:
                rows[:, dc : dc + 3] = (cloud.colors[part].astype(np.float64) - 0.5) / C0
            rows[:, column["opacity"]] = _logit(cloud.opacities[part])
            first = column["scale_0"]
            rows[:, first : first + 2] = np.log(cloud.scales[part].astype(np.float64))
            if not native_2dgs:
                rows[:, first + 2] = _log_thickness(cloud, part)
            rows[:, column["rot_0"] : column["rot_0"] + 4] = cloud.quats[part]
            for place, numbers in enumerate(integers.values(), len(names)):
                rows.view("<i4")[:, place] = numbers[part]
            stream.write(rows.data)


def _log_thickness(cloud: SplatCloud, part: slice) -> np.ndarray | float:
    if cloud.thickness is None:
        return PADDED_LOG_SCALE
    thickness = cloud.thickness[part].astype(np.float64)
    return np.where(thickness > 0, np.log(np.where(thickness > 0, thickness, 1.0)), PADDED_LOG_SCALE)


def _logit(opacities: np.ndarray) -> np.ndarray:
    p = opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        return np.clip(np.log(p) - np.log1p(-p), -MAX_LOGIT, MAX_LOGIT)
