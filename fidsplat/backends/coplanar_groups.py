"""Sort keys of coplanar groups.

At a pixel the splats of a group are one layer, which is placed by its own depth there. So the splats of a
group must follow each other in the depth order, in front of all splats that they are compared with: a group
has one sort key for each view, on all backends.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from fidsplat.backends.batched_views import ViewBatch
from fidsplat.backends.view import View
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.rotations import quaternion_to_matrix


class PlaneTable:
    """The coplanar groups of a cloud, by a dense index in the order of their ids, and boxes that bound their
    splats.

    A box is aligned with one splat of the group (two tangents and the normal), which does not depend on the
    order in which the splats are stored.
    """

    index: np.ndarray
    """(n,) int32: index of each splat's group; -1 for none"""

    def __init__(self, cloud: SplatCloud) -> None:
        ids = np.full(len(cloud), -1, np.int32) if cloud.coplanar_groups is None else cloud.coplanar_groups
        grouped = np.flatnonzero(ids >= 0)
        grouped = grouped[np.lexsort((*cloud.quats[grouped].T, *cloud.means[grouped].T))]
        known, first, which = np.unique(ids[grouped], return_index=True, return_inverse=True)
        self.index = np.full(len(cloud), -1, np.int32)
        self.index[grouped] = which
        rotations = quaternion_to_matrix(cloud.quats[grouped])
        self._labels = cloud.labels[grouped[first]]
        self._axes = np.swapaxes(rotations[first], 1, 2)  # (p, 3, 3): rows are unit axes
        axes = self._axes[which]
        centers = np.einsum("nkj,nj->nk", axes, cloud.means[grouped].astype(np.float64))
        tangents = rotations[:, :, :2] * cloud.scales[grouped].astype(np.float64)[:, None, :]
        spread = np.linalg.norm(axes @ tangents, axis=2)
        shape = (len(known), 3)
        low, high, self._sigma = np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros(shape)
        np.minimum.at(low, which, centers)
        np.maximum.at(high, which, centers)
        np.maximum.at(self._sigma, which, spread)
        self._center, self._half = (low + high) / 2, (high - low) / 2
        # the corners of a box do not depend on the cut-off
        self._min_radius = 0.0 if cloud.boxes is None else math.sqrt(2.0)

    def keys(self, view: View) -> np.ndarray:
        """(p,) float32, all different: a group's nearest depth less the diameter of its splats [m]. Depth is
        the view's: along z, or the distance from the camera's centre.

        A splat in front of the group at some pixel, with its centre at most a diameter nearer than the
        group, is rendered after it and can be placed before it; so can a splat behind it.
        """
        return self.keys_of(ViewBatch.single(view))[0]

    def keys_of(self, views: ViewBatch) -> np.ndarray:
        """(views, p) float32: the keys of each view."""
        view, axes, depths = views.view, views.rotation[:, :, 2], views.translation[:, :, 2]
        keys = self._keys(view, axes[0], depths[0], views.eye[0])
        for k, (label, _) in enumerate(view.groups, 1):
            moved = self._keys(view, axes[k], depths[k], views.eye[k])
            keys = np.where(self._labels == label, moved, keys)
        # of equal keys the index decides, and shuffled splats of two groups would mix
        order = np.argsort(keys, axis=1, kind="stable")
        steps = np.diff(np.take_along_axis(keys, order, axis=1), axis=1)
        for number in np.flatnonzero(~(steps > 0).all(1)):
            own = keys[number]
            for before, here in pairwise(order[number]):
                if own[here] <= own[before]:
                    own[here] = np.nextafter(own[before], np.float32(np.inf))
        return keys

    def _keys(self, view: View, axis: np.ndarray, depth: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """(views, p): keys by the camera's z axis (views, 3), the depth of the origin (views,) and the eye
        (views, 3)."""
        radius = max(math.sqrt(-2 * view.log_cut), self._min_radius)
        half = self._half + radius * self._sigma
        if view.along_ray:
            aside = np.abs((self._axes @ eye[:, None, :, None])[..., 0] - self._center) - half
            nearest = np.linalg.norm(np.maximum(aside, 0.0), axis=2)
        else:
            along = (self._axes @ axis[:, None, :, None])[..., 0]  # (views, p, 3): depth per metre
            # row by row, so that a view is rounded as if it were alone
            rows, centers = along.reshape(-1, 3), np.tile(self._center, (len(axis), 1))
            centre = np.einsum("pk,pk->p", rows, centers).reshape(along.shape[:2])
            nearest = centre + depth[:, None] - (np.abs(along) * half).sum(2)
        return (nearest - 2 * np.linalg.norm(half, axis=1)).astype(np.float32)
