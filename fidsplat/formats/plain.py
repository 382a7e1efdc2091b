"""What formats beside PLY have in common: a cloud as arrays with three scales and SH, and back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fidsplat.splats.arrays import find_defects
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import C0
from fidsplat.util import interrupts
from fidsplat.util.errors import InputError
from fidsplat.util.files import open_input, read_input

PADDED = np.float32(1e-6)
"""third scale, in metres, of a disk in formats that want three"""
HALF_TURN = np.diag([1.0, -1.0, -1.0, 1.0])
"""about x: between y down, z away, as splats are trained, and y up, z towards one, as glTF, USD and SPZ
are"""
C0_SPLAT = np.float32(C0)


def refuse_boxes(cloud: SplatCloud, what: str) -> None:
    """Raises InputError for boxes, which no format holds."""
    if cloud.boxes is not None:
        raise InputError(
            f"{int(cloud.boxes.sum())} of {len(cloud)} splats are boxes, which {what} cannot hold; write the "
            "marker's Gaussians instead (Marker.gaussians), or make it with mixture='fitted'"
        )


def world_means(cloud: SplatCloud) -> np.ndarray:
    """(n, 3) float32 in the world; the bits of the cloud's own where it has no origin."""
    return cloud.world_means().astype(np.float32) if cloud.origin.any() else cloud.means


def three_scales(cloud: SplatCloud) -> np.ndarray:
    """(n, 3) float32 metres; the third of a disk is 1e-6."""
    third = np.zeros(len(cloud), np.float32) if cloud.thickness is None else cloud.thickness
    return np.column_stack([cloud.scales, np.where(third > 0, third, PADDED)]).astype(np.float32)


def coefficients(cloud: SplatCloud) -> np.ndarray:
    """(n, k, 3) float32 SH; plain colours as those of degree 0."""
    if cloud.sh is not None:
        return cloud.sh
    assert cloud.colors is not None
    return ((cloud.colors.astype(np.float64) - 0.5) / C0).astype(np.float32)[:, None, :]


def plain_colors(cloud: SplatCloud) -> np.ndarray:
    """(n, 3) float32 RGB, of SH the part of degree 0."""
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
    """The cloud of a file's arrays, scales (n, 3) in metres; what cannot be drawn is left out and counted.

    disk: third scales up to this, but for rounding, are those of disks.

    Raises InputError for arrays that make no splats, or unusable coplanar groups.
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
        given = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "sh": sh}
        kept, _ = find_defects({name: np.asarray(array, np.float32) for name, array in given.items()})
        coplanar_groups = coplanar_groups[kept]
    try:
        return cloud.with_coplanar_groups(coplanar_groups)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def content(path: Path, begins: tuple[bytes, ...]) -> bytes:
    """A file's bytes; where they begin with none of these, behind spaces, its first ones alone, from which
    its reader sees that it is another's. Raises InputError as `read_input`."""
    with open_input(path) as stream:
        head = stream.read(64)
        while head.isspace():
            head = stream.read(1 << 16)
    return read_input(path) if head.lstrip().startswith(begins) else head
