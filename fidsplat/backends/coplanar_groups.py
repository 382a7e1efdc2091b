"""Conversion of coplanar group ids to dense indices 0, 1, 2, ... for devices."""

from __future__ import annotations

import numpy as np

from fidsplat.splats.cloud import SplatCloud


def group_index(cloud: SplatCloud) -> np.ndarray:
    """(n,) int32: index of each splat's coplanar group in the order of the ids, -1 for none."""
    index = np.full(len(cloud), -1, np.int32)
    if cloud.coplanar_groups is not None:
        grouped = cloud.coplanar_groups >= 0
        index[grouped] = np.unique(cloud.coplanar_groups[grouped], return_inverse=True)[1]
    return index
