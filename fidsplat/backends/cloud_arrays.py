"""Arrays of a cloud in the form in which kernels read them."""

from __future__ import annotations

from typing import Any

import numpy as np

from fidsplat.splats.arrays import present_arrays
from fidsplat.splats.cloud import SplatCloud


def kernel_arrays(cloud: SplatCloud) -> dict[str, Any]:
    """Arrays of a cloud by name, with colours instead of SH of degree 0, and int32 for groups and boxes."""
    arrays = present_arrays(cloud)
    if cloud.coplanar_groups is not None:
        arrays["coplanar_groups"] = group_index(cloud)
    if cloud.boxes is not None:
        arrays["boxes"] = cloud.boxes.astype(np.int32)
    if cloud.sh is not None and (colors := cloud.plain_colors) is not None:
        del arrays["sh"]
        arrays["colors"] = colors
    return arrays


def group_index(cloud: SplatCloud) -> np.ndarray:
    """(n,) int32: dense index 0, 1, 2, ... of each splat's coplanar group, in the order of ids; -1: none."""
    index = np.full(len(cloud), -1, np.int32)
    if cloud.coplanar_groups is not None:
        grouped = cloud.coplanar_groups >= 0
        index[grouped] = np.unique(cloud.coplanar_groups[grouped], return_inverse=True)[1]
    return index
