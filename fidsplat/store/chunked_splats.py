"""Chunked splats: several stores, followed by a cloud in memory, as one scene that is read in chunks."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fidsplat.capture.quality import Quality
from fidsplat.splats.arrays import group_offsets, present_arrays
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.harmonics import colors_of_degree
from fidsplat.store.layout import MAX_SPLATS
from fidsplat.store.partial_cloud import PartialCloud, concatenated
from fidsplat.store.store import Store
from fidsplat.store.subchunks import Subchunks, SubchunkTable
from fidsplat.util.errors import InputError

HOST_CACHE_BYTES = 2 * 2**30
"""capacity in bytes of the cache of chunks whose arrays are computed and not mapped from files"""

CellSizes = float | tuple[tuple[float, ...], ...]
"""projected size [samples] below which cells are merged: one number, or one for each level of each store"""

NodeMasks = tuple[np.ndarray, ...]
"""mask (instances * nodes,) bool of the selected nodes of each store; a node is a chunk of splats, or of
merged splats of a level of detail"""


@dataclass(frozen=True)
class Selection:
    """Selected nodes of each store, with all their rows or ranges of rows, in splat order."""

    nodes: tuple[tuple[int, ...], ...]
    """numbers of the nodes of each store; a node occurs once for each range of rows"""
    rows: tuple[tuple[tuple[int, int], ...], ...] | None = None
    """range of rows of each node: first row and number of rows; None: all rows"""

    @staticmethod
    def of(masks: NodeMasks) -> Selection:
        """All rows of the nodes that masks select."""
        return Selection(tuple(tuple(np.flatnonzero(mask).tolist()) for mask in masks))

    @staticmethod
    def of_subchunks(subchunks: Sequence[Subchunks]) -> Selection:
        """The rows of subchunks of each store."""
        return Selection(
            tuple(tuple(part.nodes.tolist()) for part in subchunks),
            tuple(tuple(zip(part.first.tolist(), part.rows.tolist(), strict=True)) for part in subchunks),
        )

    def __len__(self) -> int:
        return sum(len(set(nodes)) for nodes in self.nodes)


class ChunkedSplats:
    """Splats of stores, then of a cloud in memory, as one scene that is read in chunks. Thread-safe."""

    def __init__(self, stores: Sequence[Store], in_memory: SplatCloud | None = None) -> None:
        self.stores = tuple(stores)
        self.in_memory = SplatCloud.empty() if in_memory is None else in_memory
        self.origin = self.stores[0].origin
        """(3,) float64 metres: world position that means are relative to"""
        parts = [*self.stores, self.in_memory] if len(self.in_memory) else list(self.stores)
        self.sh_degree = max(max(part.sh_degree for part in parts), -1)
        if self.sh_degree == 0:
            self.sh_degree = -1
        self.has_coplanar_groups = any(part.has_coplanar_groups for part in parts)
        footprints = {part.footprint for part in parts if len(part)} or {"gaussian"}
        self.footprint = footprints.pop() if len(footprints) == 1 else "mixed"
        ellipsoids = {part.ellipsoids for part in parts if len(part)} or {"none"}
        self.ellipsoids = ellipsoids.pop() if len(ellipsoids) == 1 else "some"
        if len(self) > MAX_SPLATS:
            raise InputError(
                f"a scene must have at most {MAX_SPLATS:,} splats, got {len(self):,}; use fewer stores"
            )
        self._cache: OrderedDict[tuple[int, int], dict[str, np.ndarray]] = OrderedDict()
        self._cache_bytes, self._lock = 0, threading.Lock()

    def __len__(self) -> int:
        return sum(map(len, self.stores)) + len(self.in_memory)

    @property
    def content(self) -> tuple:
        """Digests of the stores, and the cloud in memory; for digests of the scene."""
        return (*(store.identity for store in self.stores), self.in_memory)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Axis-aligned box (min (3,), max (3,)) float64, world, around all splats."""
        boxes = [part.bounds() for part in (*self.stores, self.in_memory) if len(part)]
        if not boxes:
            raise InputError("the scene must have at least one splat to have bounds, got none")
        low, high = zip(*boxes, strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def cloud(self) -> SplatCloud:
        """All splats in one cloud."""
        if len(self.stores) == 1 and not len(self.in_memory):
            return self.stores[0].cloud()
        return self.load(self.all_chunks())

    def all_chunks(self) -> Selection:
        """All chunks, without nodes of levels of detail."""
        masks = (np.tile(store.nodes["level"] == 0, store.instances) for store in self.stores)
        return Selection.of(tuple(masks))

    def cell_sizes(self, *qualities: Quality) -> CellSizes:
        """Projected size [samples] below which cells are merged, by the lowest `detail_error` of the
        qualities; 0: exact. Raises InputError if a store's levels of detail were not measured."""
        if not all(quality.detail_error for quality in qualities):
            return 0.0
        sizes_by_store = ([store.cell_sizes(quality) for quality in qualities] for store in self.stores)
        return tuple(tuple(np.min(sizes, axis=0).tolist()) for sizes in sizes_by_store)

    # index: boxes, counts and subchunks of nodes

    @cached_property
    def node_counts(self) -> tuple[np.ndarray, ...]:
        """Number of splats of each store's nodes, (instances * nodes,) int64."""
        return tuple(np.tile(store.nodes["count"].astype(np.int64), store.instances) for store in self.stores)

    @cached_property
    def pinned(self) -> NodeMasks:
        """Masks of chunks with coplanar groups, which are part of every frame."""
        return tuple(
            np.tile(
                (store.nodes["level"] == 0) & (store.nodes["first"] >= store.header.pinned), store.instances
            )
            for store in self.stores
        )

    def bounding_boxes(self, number: int, sigmas: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners (instances * nodes, 3) [m] of boxes around a store's nodes, relative to the origin."""
        store = self.stores[number]
        low, high = store.bounding_boxes(sigmas)
        return low + (store.origin - self.origin), high + (store.origin - self.origin)

    def subchunks(self, masks: NodeMasks) -> list[Subchunks]:
        """Subchunks of selected nodes, for each store."""
        tables = zip(self._subchunk_tables, masks, strict=True)
        return [table.of(np.flatnonzero(mask)) for table, mask in tables]

    @cached_property
    def _subchunk_tables(self) -> list[SubchunkTable]:
        pairs = zip(self.stores, self.pinned, strict=True)
        return [SubchunkTable(store, store.origin - self.origin, pinned) for store, pinned in pairs]

    # splats of a selection

    def load(self, selection: Selection) -> PartialCloud:
        """The splats of a selection of complete nodes."""
        parts = [self.chunk(number, node) for number, nodes in enumerate(selection.nodes) for node in nodes]
        if len(self.in_memory) or not parts:
            parts.append(self.in_memory_arrays)
        return PartialCloud.of(concatenated(parts), self)

    def ids(self, selection: Selection) -> np.ndarray:
        """Scene indices (n,) int32 of the splats of a selection; -1 for splats of levels of detail."""
        ids, first = [np.empty(0, np.int32)], 0
        for number, (store, nodes) in enumerate(zip(self.stores, selection.nodes, strict=True)):
            numbers = np.array(nodes, np.int64)
            starts, counts = store.first_of(numbers), store.counts(numbers)
            if selection.rows is not None:
                rows = np.array(selection.rows[number], np.int64).reshape(-1, 2)
                starts, counts = np.where(starts < 0, -1, starts + rows[:, 0]), rows[:, 1]
            for start, count in zip(starts, counts, strict=True):
                indices = np.full(count, -1) if start < 0 else np.arange(first + start, first + start + count)
                ids.append(indices.astype(np.int32))
            first += len(store)
        ids.append(np.arange(first, first + len(self.in_memory), dtype=np.int32))
        return np.concatenate(ids)

    def prefetch(self, selection: Selection) -> None:
        """Load the nodes of a selection into memory."""
        for number, nodes in enumerate(selection.nodes):
            for node in nodes:
                for array in self.chunk(number, node).values():
                    # the system loads a page of a mapped file when one of its bytes is read
                    array.reshape(-1).view(np.uint8)[:: 1 << 12].max(initial=0)

    def chunk(self, number: int, node: int) -> dict[str, np.ndarray]:
        """Arrays of a node of a store, with the columns of this scene and relative to its origin."""
        store, key = self.stores[number], (number, node)
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        arrays = self._with_columns(
            self._relative(store.load(node), store.origin), self._first_groups[number]
        )
        computed = sum(array.nbytes for array in arrays.values() if array.base is None)
        if computed * 4 >= sum(array.nbytes for array in arrays.values()):
            with self._lock:
                self._cache_bytes += 0 if key in self._cache else computed
                self._cache[key] = arrays
                while self._cache_bytes > HOST_CACHE_BYTES and len(self._cache) > 1:
                    _, evicted = self._cache.popitem(last=False)
                    self._cache_bytes -= sum(a.nbytes for a in evicted.values() if a.base is None)
        return arrays

    def unplaced_chunk(self, number: int, node: int) -> dict[str, np.ndarray]:
        """Arrays of a node of an instanced store, without the pose of the instance."""
        return self._with_columns(self.stores[number].load(node, placed=False), self._first_groups[number])

    @cached_property
    def in_memory_arrays(self) -> dict[str, np.ndarray]:
        """Arrays of the cloud in memory, with the columns of this scene and relative to its origin."""
        arrays = self._relative(present_arrays(self.in_memory), self.in_memory.origin)
        return self._with_columns(arrays, self._first_groups[-1])

    @cached_property
    def _first_groups(self) -> list[int]:
        """Offsets added to the group ids of each store, and of the cloud in memory."""
        ids = self.in_memory.coplanar_groups
        last_group = -1 if ids is None else int(ids.max(initial=-1))
        return group_offsets([*(store.last_group() for store in self.stores), last_group])

    def _relative(self, arrays: dict[str, np.ndarray], origin: np.ndarray) -> dict[str, np.ndarray]:
        """The arrays with means relative to this scene's origin. origin: origin of the given means."""
        offset = origin - self.origin
        if not offset.any():
            return arrays
        return arrays | {"means": (arrays["means"] + offset).astype(np.float32)}

    def _with_columns(self, arrays: dict[str, np.ndarray], first_group: int) -> dict[str, np.ndarray]:
        """The arrays with the columns of this scene. first_group: offset added to coplanar group ids."""
        count = len(arrays["means"])
        columns = {name: arrays[name] for name in ("means", "quats", "scales", "opacities", "labels")}
        columns |= colors_of_degree(arrays, self.sh_degree)
        if self.has_coplanar_groups:
            ids = arrays.get("coplanar_groups", np.full(count, -1, np.int32))
            columns["coplanar_groups"] = np.where(ids >= 0, ids + np.int32(first_group), np.int32(-1))
        if self.ellipsoids != "none":
            columns["thickness"] = arrays.get("thickness", np.zeros(count, np.float32))
        if self.footprint != "gaussian":
            columns["boxes"] = arrays.get("boxes", np.zeros(count, bool))
        return columns
