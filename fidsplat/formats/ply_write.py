"""Writing of splats to PLY files in the layout of the 2DGS authors."""

import os

import numpy as np

from fidsplat.formats.collect import PADDED_LOG_SCALE
from fidsplat.formats.plain import refuse_boxes
from fidsplat.formats.ply import ORIGIN_COMMENT
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util.arguments import flag, instance
from fidsplat.util.errors import InputError
from fidsplat.util.files import atomic_write

_BLOCK = 65536
MAX_LOGIT = 100.0
"""logit of opacity 1, and -100 of opacity 0, whose sigmoid is 1 and 0 in float32"""


def save_ply(cloud: SplatCloud, path: str | os.PathLike[str], native_2dgs: bool = False) -> None:
    """Write binary little-endian PLY, all float32: x y z nx ny nz f_dc_* f_rest_* opacity scale_* rot_*.

    The third scale is the thickness of a 3D Gaussian, and log(1e-6) for a disk, so that 3DGS tools open the
    file; `native_2dgs` omits it. Plain colours become SH of degree 0. Optional int properties are label, if
    any label is not 0, and plane, the coplanar group. A comment has an origin other than 0; x, y, z are
    relative to it.

    Raises InputError for a file that cannot be written, boxes, or 3D Gaussians with `native_2dgs`; an
    existing file then stays unchanged.
    """
    refuse_boxes(instance("cloud", cloud, SplatCloud), "a PLY file")
    if flag("native_2dgs", native_2dgs) and cloud.thickness is not None:
        raise InputError(
            "splats must be disks for native_2dgs, got "
            f"{int((cloud.thickness > 0).sum())} 3D Gaussians of {len(cloud)}; use native_2dgs=False, or "
            "flatten them by cloud.flattened()"
        )
    rest = 0 if cloud.sh is None else 3 * (cloud.sh.shape[1] - 1)
    names = [
        *"xyz",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(rest)),
    ]
    names += [
        "opacity",
        "scale_0",
        "scale_1",
        *([] if native_2dgs else ["scale_2"]),
        *(f"rot_{i}" for i in range(4)),
    ]
    whole = {"label": cloud.labels} if cloud.labels.any() else {}
    if cloud.coplanar_groups is not None:
        whole["plane"] = cloud.coplanar_groups
    column = {name: i for i, name in enumerate(names)}
    lines = ["ply", "format binary_little_endian 1.0"]
    if cloud.origin.any():
        lines.append(f"comment {ORIGIN_COMMENT} {' '.join(repr(float(v)) for v in cloud.origin)}")
    lines += [f"element vertex {len(cloud)}", *(f"property float {name}" for name in names)]
    lines += [*(f"property int {name}" for name in whole), "end_header", ""]
    with atomic_write(path) as stream:
        stream.write("\n".join(lines).encode("ascii"))
        for start in range(0, len(cloud), _BLOCK):
            part = slice(start, start + _BLOCK)
            n = len(cloud.means[part])
            rows = np.zeros((n, len(names) + len(whole)), "<f4")
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
            for place, numbers in enumerate(whole.values(), len(names)):
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
