"""Level-of-detail selection: the coarsest visible nodes within the allowed error."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.store.chunked_splats import CellSizes, ChunkedSplats, NodeMasks, Selection
from fidsplat.streaming.frustum_culling import in_frustum, projected_sizes


def select(
    scene: ChunkedSplats, views: Sequence[View], features: FeatureSet, cell_sizes: CellSizes = 0.0
) -> Selection:
    """The visible nodes of views. cell_sizes: projected size below which cells are merged; 0: exact."""
    return Selection.of(visible_nodes(scene, views, features, cell_sizes))


def visible_nodes(
    scene: ChunkedSplats, views: Sequence[View], features: FeatureSet, cell_sizes: CellSizes = 0.0
) -> NodeMasks:
    """Masks of the visible nodes of views, each the coarsest that the cell sizes allow."""
    masks = []
    for number, store in enumerate(scene.stores):
        sizes = cell_sizes[number] if isinstance(cell_sizes, tuple) else (cell_sizes,) * (store.levels + 1)
        masks.append(_visible_nodes(scene, number, views, features, np.array(sizes)))
    return tuple(masks)


def _visible_nodes(
    scene: ChunkedSplats, number: int, views: Sequence[View], features: FeatureSet, cell_sizes: np.ndarray
) -> np.ndarray:
    """Mask (instances * nodes,) of the visible nodes of one store. cell_sizes: (levels + 1,) samples."""
    store, boxes = scene.stores[number], partial(scene.bounding_boxes, number)
    if not len(store.nodes):
        return np.zeros(0, bool)
    nodes, instances = store.nodes, store.instances
    level = np.tile(nodes["level"], instances)
    max_sigma = np.tile(nodes["reach"].astype(np.float64), instances)
    visible = np.zeros(len(level), bool)
    for view in views:
        visible |= in_frustum(view, features, boxes, max_sigma)
    pinned = scene.pinned[number]
    if not cell_sizes.any():
        return (visible | pinned) & (level == 0)
    parents = np.tile(nodes["parent"].astype(np.int64), instances)
    parents = np.where(parents >= 0, parents + np.repeat(np.arange(instances), len(nodes)) * len(nodes), -1)
    edges = np.tile(nodes["size"].astype(np.float64), instances)
    refined = np.zeros(len(level), bool)
    for view in views:
        refined |= projected_sizes(view, boxes, edges) > cell_sizes[level]
    reached = parents < 0
    for parent_level in range(int(level.max()), 0, -1):
        children = np.flatnonzero((level == parent_level - 1) & (parents >= 0))
        reached[children] = (reached & refined & visible)[parents[children]]
    return ((reached & visible) | pinned) & (~refined | (level == 0))
