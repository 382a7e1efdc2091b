"""Occlusion test of bounding boxes of splats against the termination depths of a frame's tiles, at which
blending of a tile stops.

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
from fidsplat.streaming.frustum_culling import PADDING, BoundingBoxes, CameraBoxes, Extent, ewa_extent

_DEPTH_RANGE = 3.33
"""standard deviations within which the depth of a splat's fragments varies (effect/order_pixel.cl)"""


def is_supported(view: View, features: FeatureSet) -> bool:
    """Whether occlusion can be tested: one pose, no moving groups, and splats of bounded extent."""
    return not (view.sub_frames or view.groups) and _extent(view, features) is not None


def min_sort_keys(view: View, features: FeatureSet, boxes: BoundingBoxes) -> np.ndarray:
    """Lower bound (n,) of the sort keys, which are depths [m], of the splats in each box."""
    extent = _extent(view, features)
    assert extent is not None  # the caller has checked `is_supported`
    if not {"order_centre", "order_coplanar"}.isdisjoint(features.names):
        return CameraBoxes(view, *boxes(0.0)).nearest(view)
    return extent.nearest(view, CameraBoxes(view, *boxes(extent.depth_radius)))


def occluded(
    view: View,
    features: FeatureSet,
    boxes: BoundingBoxes,
    max_sigma: np.ndarray,
    termination: TerminationDepths,
) -> np.ndarray:
    """Mask (n,) of the boxes whose splats cannot contribute to a frame with these termination depths."""
    keys = min_sort_keys(view, features, boxes)
    spans = _tile_spans(view, features, boxes, max_sigma, termination)
    return keys > _RangeMaximum(termination.depths).within(*spans)


def contributing_tiles(
    view: View,
    features: FeatureSet,
    boxes: BoundingBoxes,
    max_sigma: np.ndarray,
    termination: TerminationDepths,
) -> np.ndarray:
    """Mask (rows, columns) of the tiles to which splats of the boxes can contribute."""
    tiles = np.zeros(termination.depths.shape, bool)
    keys = min_sort_keys(view, features, boxes)
    spans = _tile_spans(view, features, boxes, max_sigma, termination)
    for key, top, bottom, left, right in zip(keys, *spans, strict=True):
        tiles[top:bottom, left:right] |= termination.depths[top:bottom, left:right] >= key
    return tiles


def node_sort_keys(scene: ChunkedSplats, view: View, features: FeatureSet) -> tuple[np.ndarray, ...]:
    """Lower bounds (instances * nodes,) of the sort keys [m] of each store's nodes."""
    numbers = range(len(scene.stores))
    return tuple(min_sort_keys(view, features, partial(scene.bounding_boxes, number)) for number in numbers)


def occluded_nodes(
    scene: ChunkedSplats, view: View, features: FeatureSet, termination: TerminationDepths
) -> NodeMasks:
    """Masks of the nodes that are occluded in a frame with these termination depths. Pinned nodes, which have
    coplanar groups, never are."""
    masks = []
    for number, (store, pinned) in enumerate(zip(scene.stores, scene.pinned, strict=True)):
        max_sigma = np.tile(store.nodes["reach"].astype(np.float64), store.instances)
        masks.append(
            occluded(view, features, partial(scene.bounding_boxes, number), max_sigma, termination) & ~pinned
        )
    return tuple(masks)


def _tile_spans(
    view: View,
    features: FeatureSet,
    boxes: BoundingBoxes,
    max_sigma: np.ndarray,
    termination: TerminationDepths,
) -> tuple[np.ndarray, ...]:
    """Rows [top, bottom) and columns [left, right) of the tiles that boxes can touch, (n,) int64 each."""
    columns = termination.depths.shape[1]
    first, end = (0, view.height) if view.sample_rows is None else view.sample_rows
    tile_rows = first // termination.tile[0], -(-end // termination.tile[0])
    if view.raster is not None:
        return tuple(np.full(len(max_sigma), border, np.int64) for border in (*tile_rows, 0, columns))
    low, high = _projected_extent(view, features, boxes, max_sigma)
    with np.errstate(invalid="ignore"):
        left = np.clip(np.floor((low[:, 0] - 1) / termination.tile[1]), 0, columns)
        right = np.clip(np.floor(high[:, 0] / termination.tile[1]) + 1, 0, columns)
        top = np.clip(np.floor((low[:, 1] - 1) / termination.tile[0]), *tile_rows)
        bottom = np.clip(np.floor(high[:, 1] / termination.tile[0]) + 1, *tile_rows)
    return tuple(span.astype(np.int64) for span in (top, bottom, left, right))


def _extent(view: View, features: FeatureSet) -> Extent | None:
    """Extent within which splats contribute, and at least that within which their depths vary."""
    return Extent.of(view, features, _DEPTH_RANGE * PADDING)


def _projected_extent(
    view: View, features: FeatureSet, boxes: BoundingBoxes, max_sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on the x and y of each box's splats on the image of a pinhole camera, (n, 2) samples each;
    infinite where a box contains the camera."""
    extent = _extent(view, features)
    assert extent is not None  # the caller has checked `is_supported`
    radius, margin = extent.radius, extent.margin
    low, high = _projected(view, *boxes(radius))
    ewa_radius = ewa_extent(view, features, radius, max_sigma[:, None])
    if ewa_radius is not None:
        low_center, high_center = _projected(view, *boxes(0.0))
        if not view.parallel:
            with np.errstate(divide="ignore", invalid="ignore"):
                nearest = CameraBoxes(view, *boxes(0.0)).nearest(view)[:, None]
                ewa_radius = np.where(nearest > 0, ewa_radius / nearest, np.inf)
        low, high = np.minimum(low, low_center - ewa_radius), np.maximum(high, high_center + ewa_radius)
    return low - margin, high + margin


def _projected(view: View, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the projected corners of boxes, (n, 2) samples each."""
    rounding = CameraBoxes(view, low, high).rounding[:, None] * math.sqrt(3.0)
    low, high = low - rounding, high + rounding
    low_xy = np.full((len(low), 2), np.inf)
    high_xy, nearest = -low_xy, np.full(len(low), np.inf)
    focal, center = np.array([view.focal_x, view.focal_y]), np.array([view.center_x, view.center_y])
    for corner in range(8):
        is_high = np.array([corner & 1, corner >> 1 & 1, corner >> 2], bool)
        point = np.where(is_high, high, low) @ view.rotation.T + view.translation
        nearest = np.minimum(nearest, point[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = focal * (point[:, :2] if view.parallel else point[:, :2] / point[:, 2:]) + center
        low_xy, high_xy = np.minimum(low_xy, xy), np.maximum(high_xy, xy)
    if not view.parallel:
        low_xy[~(nearest > 0)], high_xy[~(nearest > 0)] = -np.inf, np.inf
    return low_xy, high_xy


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
        filled = np.flatnonzero((bottom > top) & (right > left))
        log_h, log_w = (np.frexp(size[filled])[1] - 1 for size in (bottom - top, right - left))
        for down, across in {*zip(log_h.tolist(), log_w.tolist(), strict=True)}:
            rows = filled[(log_h == down) & (log_w == across)]
            table = self._table(down, across)
            low, far = bottom[rows] - (1 << down), right[rows] - (1 << across)
            first = np.maximum(table[top[rows], left[rows]], table[top[rows], far])
            maxima[rows] = np.maximum(first, np.maximum(table[low, left[rows]], table[low, far]))
        return maxima
