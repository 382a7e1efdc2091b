"""From the three axes of a 3DGS splat to the two of a 2DGS splat."""

import numpy as np

from fidsplat.rotations import quaternion_multiply

FLAT_RATIO = 0.1
"""a splat is flat when its thinnest axis is at most this part of the middle one"""

# Turning the frame cyclically keeps it right-handed. Row i makes axis i the third: its new axes are
# (y, z, x) for i = 0 and (z, x, y) for i = 1, a third of a turn about (1, 1, 1) and back.
_TURNS = np.array([[0.5, 0.5, 0.5, 0.5], [0.5, -0.5, -0.5, -0.5], [1.0, 0.0, 0.0, 0.0]])
_KEPT = np.array([[1, 2], [2, 0], [0, 1]])


def flatten(quats: np.ndarray, scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make the thinnest axis of each 3D Gaussian the normal of a 2D one.

    quats (n, 4) wxyz, scales (n, 3) standard deviations -> quats (n, 4), scales (n, 2), thickness (n,), the
    thinnest axis over the middle one (NaN unless all three are finite). The third axis wins ties. A NaN
    among the three scales spoils both that are kept, so that the splat is not taken for a good one.
    """
    quats, scales = np.asarray(quats), np.asarray(scales)
    thin = 2 - np.argmin(scales[:, ::-1], axis=1)
    flat_scales = np.take_along_axis(scales, _KEPT[thin], axis=1)
    turned = thin != 2
    if turned.any():
        quats = quats.copy()
        with np.errstate(over="ignore", invalid="ignore"):
            quats[turned] = quaternion_multiply(quats[turned], _TURNS[thin[turned]])
    with np.errstate(divide="ignore", invalid="ignore"):
        thickness = scales.min(axis=1) / flat_scales.min(axis=1)
    thickness[~np.isfinite(scales).all(axis=1)] = np.nan
    flat_scales[np.isnan(scales).any(axis=1)] = np.nan
    return quats, flat_scales, thickness


def not_flat_report(thickness: np.ndarray) -> str | None:
    """One line on the splats (thickness (n,)) that are not flat, or None when all are."""
    known = thickness[np.isfinite(thickness)]
    thick = int((known > FLAT_RATIO).sum())
    if not thick:
        return None
    return (
        f"3D splats that are not flat become 2D splats: {thick} of {len(thickness)} have a thinnest axis "
        f"above {FLAT_RATIO} of the middle one (median of all: {np.median(known):.2g})"
    )
