"""Conversion between clouds and the arrays of formats other than PLY: three scales and SH."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fidsplat.splats.arrays import find_defects
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError, error_prefix
from fidsplat.util.files import open_input, read_input

PADDED = np.float32(1e-6)
"""third scale in metres that marks a disk in formats that require three scales"""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""rotation by 180 degrees about x: from y down, z forward (trained splats) to y up, z backward (glTF, USD,
SPZ)"""
C0_SPLAT = np.float32(C0)


def refuse_boxes(cloud: SplatCloud, what: str) -> None:
    """Raise InputError for boxes, which no file format can store."""
    if cloud.boxes is not None:
        raise InputError(
            f"splats in {what} must be Gaussians, got {int(cloud.boxes.sum())} boxes of {len(cloud)}; write "
            "Marker.gaussians, or make the marker with mixture='fitted'"
        )


def world_means(cloud: SplatCloud) -> np.ndarray:
    """Means (n, 3) float32 in world coordinates, without an origin."""
    return cloud.world_means().astype(np.float32) if cloud.origin.any() else cloud.means


def three_scales(cloud: SplatCloud) -> np.ndarray:
    """Three scales (n, 3) float32 [m]; the third of a disk is 1e-6."""
    third = np.zeros(len(cloud), np.float32) if cloud.thickness is None else cloud.thickness
    return np.column_stack([cloud.scales, np.where(third > 0, third, PADDED)]).astype(np.float32)


def coefficients(cloud: SplatCloud) -> np.ndarray:
    """SH coefficients (n, k, 3) float32; plain colours become degree 0."""
    if cloud.sh is not None:
        return cloud.sh
    assert cloud.colors is not None
    return ((cloud.colors.astype(np.float64) - 0.5) / C0).astype(np.float32)[:, None, :]


def plain_colors(cloud: SplatCloud) -> np.ndarray:
    """RGB (n, 3) float32 at SH degree 0."""
    return coefficients(cloud)[:, 0] * C0_SPLAT + np.float32(0.5)


def cloud_of(
    path: Path,
    means,
    quats,
    scales,
    opacities,
    sh,
    disk: float = float(PADDED),
    labels=None,
    coplanar_groups=None,
) -> SplatCloud:
    """Cloud of a file's arrays, with scales (n, 3) in metres; invalid splats are dropped and counted.

    disk: maximum third scale of a disk, before rounding.

    Raises InputError for invalid arrays or coplanar groups.
    """
    interrupts.check()
    scales = np.array(scales, np.float32)
    scales[scales[:, 2] <= np.float32(disk * (1 + 1e-5)), 2] = 0
    cloud = SplatCloud(means, quats, scales, opacities, sh=sh, labels=labels, source=str(path))
    if coplanar_groups is None:
        return cloud
    if coplanar_groups.shape != (len(means),):
        raise InputError(
            f"{path}: coplanar groups must have the shape ({len(means)},), got {coplanar_groups.shape}"
        )
    if cloud.dropped:
        arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        valid, _ = find_defects({name: np.asarray(array, np.float32) for name, array in arrays.items()})
        coplanar_groups = coplanar_groups[valid]
    with error_prefix(str(path)):
        return cloud.with_coplanar_groups(coplanar_groups)


def content(path: Path, magic: tuple[bytes, ...]) -> bytes:
    """Content of a file, or only its first bytes if it does not begin with one of these magic numbers, so
    that a large file of another format is not read. White space at the beginning is ignored."""
    with open_input(path) as stream:
        head = stream.read(64)
        if not head:
            raise InputError(f"cannot read {path}: it is empty")
        while head.isspace():
            head = stream.read(1 << 16)
    return read_input(path) if head.lstrip().startswith(magic) else head


def neighbour(path: Path, name: str) -> Path:
    """A file in the folder of `path` or below it. Raises InputError for a name outside it, or a
    URL."""
    folder = path.parent.resolve()
    try:
        file = (folder / name).resolve()
        inside = "://" not in name and file.is_relative_to(folder)
    except (OSError, ValueError, RuntimeError):  # a name with NUL, a loop of symbolic links
        inside = False
    if not inside:
        raise InputError(f"files of {path} must be in its folder, got {name!r}")
    return file
