"""Where the splats of a plane arrive in the depth order: together, before anything they are compared with.

At a pixel the splats of a plane are one layer, which is placed by its own depth there. So they may not arrive
one by one, by the depth of their centres: a plane has one sort key for each view. Every backend takes it
from here.
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
    """The planes of a cloud, by a dense index in the order of their ids, and boxes that bound their splats.

    A box stands in the frame of one of the plane's splats (two tangents and the normal), whichever the order
    in which they are stored.
    """

    index: np.ndarray
    """(n,) int32: which plane each splat is printed on, from 0; -1 for none"""

    def __init__(self, cloud: SplatCloud) -> None:
        ids = np.full(len(cloud), -1, np.int32) if cloud.coplanar_groups is None else cloud.coplanar_groups
        on_plane = np.flatnonzero(ids >= 0)
        on_plane = on_plane[np.lexsort((*cloud.quats[on_plane].T, *cloud.means[on_plane].T))]
        known, first, which = np.unique(ids[on_plane], return_index=True, return_inverse=True)
        self.index = np.full(len(cloud), -1, np.int32)
        self.index[on_plane] = which
        turns = quaternion_to_matrix(cloud.quats[on_plane])
        self._labels = cloud.labels[on_plane[first]]
        self._axes = np.swapaxes(turns[first], 1, 2)  # (p, 3, 3): rows are unit axes
        axes = self._axes[which]
        centers = np.einsum("nkj,nj->nk", axes, cloud.means[on_plane].astype(np.float64))
        tangents = turns[:, :, :2] * cloud.scales[on_plane].astype(np.float64)[:, None, :]
        spread = np.linalg.norm(axes @ tangents, axis=2)
        shape = (len(known), 3)
        low, high, self._sigma = np.full(shape, np.inf), np.full(shape, -np.inf), np.zeros(shape)
        np.minimum.at(low, which, centers)
        np.maximum.at(high, which, centers)
        np.maximum.at(self._sigma, which, spread)
        self._center, self._half = (low + high) / 2, (high - low) / 2
        # a box reaches its corners whatever the cut-off
        self._least_radius = 0.0 if cloud.boxes is None else math.sqrt(2.0)

    def keys(self, view: View) -> np.ndarray:
        """(p,) float32, all different: a plane's nearest depth less its splats' diameter [m]. Depth is what
        the view means by it: along z, or the distance from the camera's centre.

        Whatever lies before the plane at some pixel, with its centre at most a diameter nearer than the
        plane, arrives after it and can be placed before it; so can what lies behind.
        """
        every = [view, *(own for _, own in view.groups)]
        axes, depths, eyes = (
            np.stack([of(one) for one in every])[:, None]
            for of in (lambda v: v.rotation[2], lambda v: v.translation[2], lambda v: v.eye)
        )
        return self._keys_of(view, axes, depths, eyes)[0].copy()

    def keys_of(self, stack: ViewBatch) -> np.ndarray:
        """(views, p) float32: the keys of each view."""
        axes, depths = stack.rotation[:, :, 2], stack.translation[:, :, 2]
        return self._keys_of(stack.view, axes, depths, stack.eye)

    def _keys_of(self, view: View, axes: np.ndarray, depths: np.ndarray, eyes: np.ndarray) -> np.ndarray:
        """From the camera's z axis (groups + 1, views, 3), the depth of the origin (groups + 1, views) and
        the eye (groups + 1, views, 3): (views, p)."""
        keys = self._keys(view, axes[0], depths[0], eyes[0])
        for k, (label, _) in enumerate(view.groups, 1):
            keys = np.where(self._labels == label, self._keys(view, axes[k], depths[k], eyes[k]), keys)
        # of equal keys the index decides, and shuffled splats of two planes would mix
        order = np.argsort(keys, axis=1, kind="stable")
        steps = np.diff(np.take_along_axis(keys, order, axis=1), axis=1)
        for number in np.flatnonzero(~(steps > 0).all(1)):
            own = keys[number]
            for before, here in pairwise(order[number]):
                if own[here] <= own[before]:
                    own[here] = np.nextafter(own[before], np.float32(np.inf))
        return keys

    def _keys(self, view: View, axis: np.ndarray, depth: np.ndarray, eye: np.ndarray) -> np.ndarray:
        radius = max(math.sqrt(-2 * view.log_cut), self._least_radius)
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
