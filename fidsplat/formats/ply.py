"""Reading splats from a PLY file, whichever layout it has."""

import os
import warnings

import numpy as np

from fidsplat.errors import InputError
from fidsplat.formats.compressed_ply import is_compressed, read_compressed
from fidsplat.formats.flatten import flatten, not_flat_report
from fidsplat.formats.ply_header import Element, Header, read_header
from fidsplat.splats import SplatCloud

ORIGIN_COMMENT = "fidsplat origin"
"""a header comment of this beginning and three numbers holds the origin that x, y, z are relative to"""
PADDED_LOG_SCALE = np.log(1e-6)
"""scale_2 of a 2DGS cloud written for tools that want three scales; SuperSplat writes the same"""

_NEEDED = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1")
_NEEDED += ("rot_0", "rot_1", "rot_2", "rot_3")
# rows that are worked on at a time: their records and results stay in a core's cache, so that walking over
# them once per property costs no memory traffic
_BLOCK = 2048


def load_ply(path: str | os.PathLike[str]) -> SplatCloud:
    """Read a splat file: 2DGS layout (two scales), 3DGS layout (three), or SuperSplat's compressed PLY.

    Properties are found by name, in any order and among any others. Three scales become two: the thinnest
    axis of each splat becomes its normal, and one warning says how many splats were not flat. Integer
    properties ``label`` and ``plane`` are taken up. Colours come as SH of degree 0 to 3.

    Raises InputError for a file that is missing, damaged, of another kind, or lacks a property.
    """
    header = read_header(path)
    fields = read_compressed(header) if is_compressed(header) else _read_plain(header)
    if fields["scales"].shape[1] == 3:
        fields = _two_scales(header, fields)
    for array in fields.values():
        array.flags.writeable = False  # so that the cloud takes them over without a copy
    planes = fields.pop("planes", None)
    if planes is None:
        return SplatCloud(**fields, source=header.path)
    # the cloud leaves out splats that cannot be drawn: row numbers in place of labels tell which stayed
    labels = fields.pop("labels", np.zeros(len(planes), np.int32))
    cloud = SplatCloud(**fields, labels=np.arange(len(planes), dtype=np.int32), source=header.path)
    return cloud.with_planes(planes[cloud.labels]).with_labels(labels[cloud.labels])


def _read_plain(header: Header) -> dict[str, np.ndarray]:
    element = header.elements.get("vertex")
    if element is None:
        raise InputError(f"{header.path}: the PLY file has no element vertex")
    degree = _check_properties(header, element)
    names = element.properties
    n, k = element.count, (degree + 1) ** 2
    single = np.float32
    wide = any(element.dtype[axis].itemsize == 8 for axis in "xyz")
    fields = {
        "means": np.empty((n, 3), np.float64 if wide else single),
        "quats": np.empty((n, 4), single),
        "scales": np.empty((n, 3 if "scale_2" in names else 2), single),
        "opacities": np.empty(n, single),
        "sh": np.empty((n, k, 3), single),
    }
    targets = {axis: fields["means"][:, i] for i, axis in enumerate("xyz")}
    targets |= {f"rot_{i}": fields["quats"][:, i] for i in range(4)}
    targets |= {f"scale_{i}": fields["scales"][:, i] for i in range(fields["scales"].shape[1])}
    targets["opacity"] = fields["opacities"]
    targets |= {f"f_dc_{c}": fields["sh"][:, 0, c] for c in range(3)}
    # the file has all of red's higher bands, then green's, then blue's
    targets |= {
        f"f_rest_{c * (k - 1) + i}": fields["sh"][:, 1 + i, c] for c in range(3) for i in range(k - 1)
    }
    for name in ("label", "plane"):
        if name in names and np.can_cast(element.dtype[name], np.int32):
            fields[f"{name}s"] = targets[name] = np.empty(n, np.int32)
    rows = header.rows("vertex")
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, n, _BLOCK):
            block = rows[start : start + _BLOCK]
            for name, target in targets.items():
                target[start : start + _BLOCK] = block[name]
        np.exp(fields["scales"], out=fields["scales"])
        _sigmoid(fields["opacities"])
    if "planes" in fields and fields["planes"].min(initial=-1) < -1:
        raise InputError(
            f"{header.path}: the property plane holds {fields['planes'].min()}; it must be an id of at least "
            "0, or -1 for a splat of no plane"
        )
    origin = _origin(header)
    return fields if origin is None else fields | {"origin": origin}


def _check_properties(header: Header, element: Element) -> int:
    """The SH degree of a vertex element that has all that a splat needs."""
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
        raise InputError(f"{header.path}: these properties must be float or double: {', '.join(wrong)}")
    return int(np.sqrt(len(rest) // 3 + 1)) - 1


def _sigmoid(x: np.ndarray) -> None:
    """Opacity from its logit, in place; -inf and inf give exactly 0 and 1."""
    np.negative(x, out=x)
    np.exp(x, out=x)
    x += 1
    np.reciprocal(x, out=x)


def _two_scales(header: Header, fields: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    scales = fields["scales"]
    # a third scale that is 1e-6 throughout marks a 2DGS cloud: its normal is the third axis even where a
    # splat's own scales are smaller still
    if np.allclose(scales[:, 2], np.exp(PADDED_LOG_SCALE), rtol=1e-5, atol=0):
        return fields | {"scales": scales[:, :2].copy()}
    quats, two = fields["quats"], np.empty((len(scales), 2), scales.dtype)
    thickness = np.empty(len(scales), scales.dtype)
    for start in range(0, len(scales), _BLOCK):
        part = slice(start, start + _BLOCK)
        quats[part], two[part], thickness[part] = flatten(quats[part], scales[part])
    report = not_flat_report(thickness)
    if report:
        warnings.warn(f"{header.path}: {report}", stacklevel=3)
    return fields | {"scales": two}


def _origin(header: Header) -> np.ndarray | None:
    for comment in header.comments:
        if comment.startswith(ORIGIN_COMMENT):
            try:
                origin = np.array([float(word) for word in comment[len(ORIGIN_COMMENT) :].split()])
            except ValueError:
                origin = np.empty(0)
            if origin.shape != (3,) or not np.isfinite(origin).all():
                raise InputError(f"{header.path}: the comment {comment!r} must hold three finite numbers")
            return origin
    return None
