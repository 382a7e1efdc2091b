"""Occlusion test of boxes of splats against the termination depths of a frame's tiles.

A box is occluded if its lowest sort key is above the termination depth of every tile that it can touch.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.store.chunked_splats import ChunkedSplats, NodeMasks
from fidsplat.streaming.frustum_culling import PADDING, Boxes, CameraBoxes, Extent, ewa_extent

_RANGE = 3.33
"""standard deviations within which a splat's depth varies between pixels (slot/compose_pixel.cl)"""


def is_supported(view: View, features: FeatureSet) -> bool:
    """Whether occlusion can be tested: one pose, no moving groups, and splats of bounded extent."""
    return not (view.sub_frames or view.groups) and _extent(view, features) is not None


def minimum_keys(view: View, features: FeatureSet, boxes: Boxes) -> np.ndarray:
    """Lower bound (n,) on the sort keys of the splats in each box [m]."""
    extent = _extent(view, features)
    assert extent is not None  # the caller has checked `is_supported`
    if not {"compose_ordered", "compose_coplanar"}.isdisjoint(features.names):
        return CameraBoxes(view, *boxes(0.0)).nearest(view)
    return extent.nearest(view, CameraBoxes(view, *boxes(extent.depths)))


def occluded(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, termination: TerminationDepths
) -> np.ndarray:
    """Mask (n,) of the boxes whose splats cannot contribute to a frame with these termination depths."""
    keys, spans = minimum_keys(view, features, boxes), _tile_spans(view, features, boxes, reach, termination)
    return keys > _RangeMaximum(termination.depths).within(*spans)


def contributing_tiles(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, termination: TerminationDepths
) -> np.ndarray:
    """Mask (rows, columns) of the tiles to which splats of the boxes can contribute."""
    tiles = np.zeros(termination.depths.shape, bool)
    keys, spans = minimum_keys(view, features, boxes), _tile_spans(view, features, boxes, reach, termination)
    for key, top, bottom, left, right in zip(keys, *spans, strict=True):
        tiles[top:bottom, left:right] |= termination.depths[top:bottom, left:right] >= key
    return tiles


def node_keys(scene: ChunkedSplats, view: View, features: FeatureSet) -> tuple[np.ndarray, ...]:
    """Lower bounds (instances * nodes,) on the sort keys of each store's nodes [m]."""
    numbers = range(len(scene.stores))
    return tuple(minimum_keys(view, features, partial(scene.boxes, number)) for number in numbers)


def occluded_nodes(
    scene: ChunkedSplats, view: View, features: FeatureSet, termination: TerminationDepths
) -> NodeMasks:
    """Masks of the nodes that are occluded in a frame with these termination depths, except pinned ones."""
    masks = []
    for number, (store, pinned) in enumerate(zip(scene.stores, scene.pinned, strict=True)):
        reach = np.tile(store.nodes["reach"].astype(np.float64), store.instances)
        masks.append(occluded(view, features, partial(scene.boxes, number), reach, termination) & ~pinned)
    return tuple(masks)


def _tile_spans(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, termination: TerminationDepths
) -> tuple[np.ndarray, ...]:
    """Rows [top, bottom) and columns [left, right) of the tiles that boxes can touch, (n,) int64 each."""
    columns = termination.depths.shape[1]
    first, end = (0, view.height) if view.band is None else view.band
    band = first // termination.tile[0], -(-end // termination.tile[0])
    if view.raster is not None:
        return tuple(np.full(len(reach), side, np.int64) for side in (*band, 0, columns))
    low, high = _projected_extent(view, features, boxes, reach)
    with np.errstate(invalid="ignore"):
        left = np.clip(np.floor((low[:, 0] - 1) / termination.tile[1]), 0, columns)
        right = np.clip(np.floor(high[:, 0] / termination.tile[1]) + 1, 0, columns)
        top = np.clip(np.floor((low[:, 1] - 1) / termination.tile[0]), *band)
        bottom = np.clip(np.floor(high[:, 1] / termination.tile[0]) + 1, *band)
    return tuple(each.astype(np.int64) for each in (top, bottom, left, right))


def _extent(view: View, features: FeatureSet) -> Extent | None:
    """Extent within which splats contribute or have their own depth."""
    return Extent.of(view, features, _RANGE * PADDING)


def _projected_extent(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on the x and y of each box's splats on the image of a pinhole camera, (n, 2) samples each;
    infinite where a box contains the camera."""
    extent = _extent(view, features)
    assert extent is not None  # the caller has checked `is_supported`
    radius, margin = extent.radius, extent.margin
    low, high = _projected(view, *boxes(radius))
    wide = ewa_extent(view, features, radius, reach[:, None])
    if wide is not None:
        low_center, high_center = _projected(view, *boxes(0.0))
        if not view.parallel:
            with np.errstate(divide="ignore", invalid="ignore"):
                nearest = CameraBoxes(view, *boxes(0.0)).nearest(view)[:, None]
                wide = np.where(nearest > 0, wide / nearest, np.inf)
        low, high = np.minimum(low, low_center - wide), np.maximum(high, high_center + wide)
    return low - margin, high + margin


def _projected(view: View, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the projected corners of boxes, (n, 2) samples each."""
    rounding = CameraBoxes(view, low, high).rounding[:, None] * math.sqrt(3.0)
    low, high = low - rounding, high + rounding
    lowest = np.full((len(low), 2), np.inf)
    highest, nearest = -lowest, np.full(len(low), np.inf)
    focal, center = np.array([view.focal_x, view.focal_y]), np.array([view.center_x, view.center_y])
    for corner in range(8):
        which = np.array([corner & 1, corner >> 1 & 1, corner >> 2], bool)
        at = np.where(which, high, low) @ view.rotation.T + view.translation
        nearest = np.minimum(nearest, at[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            on = focal * (at[:, :2] if view.parallel else at[:, :2] / at[:, 2:]) + center
        lowest, highest = np.minimum(lowest, on), np.maximum(highest, on)
    if not view.parallel:
        lowest[~(nearest > 0)], highest[~(nearest > 0)] = -np.inf, np.inf
    return lowest, highest


class _RangeMaximum:
    """Sparse table for the maximum over rectangles of a grid."""

    def __init__(self, values: np.ndarray) -> None:
        self._tables: dict[tuple[int, int], np.ndarray] = {(0, 0): values}
        """maximum of the rectangle of 2^a x 2^b cells that starts at each cell, by exponents (a, b)"""

    def _table(self, down: int, across: int) -> np.ndarray:
        if (down, across) not in self._tables:
            if across:
                table, step = self._table(down, across - 1), 1 << (across - 1)
                maxima = np.maximum(table[:, :-step], table[:, step:])
            else:
                table, step = self._table(down - 1, 0), 1 << (down - 1)
                maxima = np.maximum(table[:-step], table[step:])
            self._tables[down, across] = maxima
        return self._tables[down, across]

    def within(self, top: np.ndarray, bottom: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Maximum (n,) in rows [top, bottom) and columns [left, right); -inf for an empty rectangle."""
        maxima = np.full(len(top), -np.inf)
        some = np.flatnonzero((bottom > top) & (right > left))
        tall, wide = (np.frexp(size[some])[1] - 1 for size in (bottom - top, right - left))
        for down, across in {*zip(tall.tolist(), wide.tolist(), strict=True)}:
            at = some[(tall == down) & (wide == across)]
            table, low, far = self._table(down, across), bottom[at] - (1 << down), right[at] - (1 << across)
            first = np.maximum(table[top[at], left[at]], table[top[at], far])
            maxima[at] = np.maximum(first, np.maximum(table[low, left[at]], table[low, far]))
        return maxima
