"""Reading and writing of `.splat`, the format of antimatter15's viewer: 32 bytes per splat.

Three float32 for the position, three for the scale in metres, then bytes for red, green, blue, opacity, and
the quaternion w, x, y, z as 128 + 128 q. Colours do not depend on the view.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fidsplat.formats.plain import cloud_of, plain_colors, refuse_boxes, three_scales, world_means
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util.errors import InputError
from fidsplat.util.files import regular_file, write_file
from fidsplat.util.limits import check_expansion

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_CHECKED_ROWS = 4096
"""rows that are validated before the remaining rows are read, since the format has no magic number"""


def load_splat(path: Path) -> SplatCloud:
    """Read a .splat file. Raises InputError for a file of another format."""
    size = regular_file(path).stat().st_size
    if not size or size % _ROW.itemsize:
        raise InputError(
            f"{path}: the size of a .splat file must be a positive multiple of {_ROW.itemsize} bytes, got "
            f"{size}"
        )
    check_expansion(path, 4 * size, f"{size // _ROW.itemsize:,} splats")
    rows = np.memmap(path, _ROW, "r").view(np.ndarray)
    means, scales = rows["means"][:_CHECKED_ROWS], rows["scales"][:_CHECKED_ROWS]
    if not (np.isfinite(means).all(1) & np.isfinite(scales).all(1) & (scales > 0).any(1)).any():
        raise InputError(f"cannot read {path} as .splat: none of its first {len(means)} rows is a splat")
    rgba = rows["rgba"].astype(np.float32) / 255
    quats = (rows["quat"].astype(np.float32) - 128) / 128
    sh = ((rgba[:, None, :3] - 0.5) / C0).astype(np.float32)
    return cloud_of(path, rows["means"], quats, rows["scales"], rgba[:, 3], sh)


def save_splat(cloud: SplatCloud, path: Path) -> None:
    """Write a .splat file. Raises InputError for boxes, an empty cloud, or a file that cannot be written."""
    refuse_boxes(cloud, "a .splat file")
    if not len(cloud):
        raise InputError("a cloud in a .splat file must have at least one splat, got none")
    rows = np.zeros(len(cloud), _ROW)
    rows["means"], rows["scales"] = world_means(cloud), three_scales(cloud)
    rgba = np.column_stack([plain_colors(cloud), cloud.opacities])
    rows["rgba"] = np.rint(np.clip(rgba, 0, 1) * 255)
    rows["quat"] = np.clip(np.rint(cloud.quats * 128 + 128), 0, 255)
    write_file(path, rows.tobytes())
