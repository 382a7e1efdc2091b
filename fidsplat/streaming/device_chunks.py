"""Chunks of a scene for the chunk cache of a device."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from fidsplat.backends.interface import Chunk
from fidsplat.store.chunked_splats import ChunkedSplats, Selection
from fidsplat.store.store import Store


class DeviceChunks:
    """Chunks of a scene, each with the function that loads its arrays."""

    def __init__(self, scene: ChunkedSplats) -> None:
        self.scene = scene
        self._chunks: dict[tuple[int, bool], dict[int, Chunk]] = {}
        """chunks by number of the store and whether the device applies poses, then by node"""

    @property
    def largest_chunk(self) -> int:
        """Number of splats of the largest node; splats in memory are split into chunks of this size."""
        return max(int(store.nodes["count"].max(initial=1)) for store in self.scene.stores)

    def of(self, selection: Selection, applies_poses: bool) -> list[Chunk]:
        """Chunks of a selection. applies_poses: whether the device applies poses of instances."""
        chunks = []
        for number, (store, nodes) in enumerate(zip(self.scene.stores, selection.nodes, strict=True)):
            posed = applies_poses and self._can_pose(store)
            cached = self._chunks.setdefault((number, posed), {})
            for index, node in enumerate(nodes):
                if (chunk := cached.get(node)) is None:
                    chunk = cached[node] = self._chunk_of(number, node, posed)
                if selection.rows is not None:
                    first, count = selection.rows[number][index]
                    chunk = replace(chunk, first=first, count=count)
                chunks.append(chunk)
        size, count = self.largest_chunk, len(self.scene.in_memory)
        for first in range(0, count if chunks else max(count, 1), size):
            end = min(first + size, count)
            chunks.append(Chunk(("in memory", first), end - first, partial(self._in_memory, first, end)))
        return chunks

    def count_distinct(self, applies_poses: bool) -> int:
        """Number of different chunk keys. applies_poses: whether the device applies poses of instances."""
        keys = (
            len(store.nodes) * (1 if applies_poses and self._can_pose(store) else store.instances)
            for store in self.scene.stores
        )
        return sum(keys) + -(-len(self.scene.in_memory) // self.largest_chunk)

    @cached_property
    def _group_ids(self) -> np.ndarray:
        """Sorted ids of all coplanar groups, whose chunks are part of every frame."""
        ids = self.scene.load(Selection.of(self.scene.pinned)).coplanar_groups
        assert ids is not None
        return np.unique(ids[ids >= 0])

    def _can_pose(self, store: Store) -> bool:
        """Whether a device may apply a store's poses. The host applies them to SH, which must be rotated, and
        to means relative to another origin, which the device would round twice."""
        offset = store.origin - self.scene.origin
        return store.poses is not None and self.scene.sh_degree < 0 and not offset.any()

    def _chunk_of(self, number: int, node: int, posed: bool) -> Chunk:
        store = self.scene.stores[number]
        instance, node_of_store = divmod(node, len(store.nodes))
        key = (number, node_of_store if posed else node)
        pose = store.pose_rows[instance] if posed else None
        return Chunk(key, int(store.nodes["count"][node_of_store]), partial(self._arrays, key, posed), pose)

    def _arrays(self, key: tuple[int, int], posed: bool) -> dict[str, np.ndarray]:
        return self._on_device(self.scene.unplaced_chunk(*key) if posed else self.scene.chunk(*key))

    def _in_memory(self, first: int, end: int) -> dict[str, np.ndarray]:
        arrays = self.scene.in_memory_arrays
        return self._on_device({name: array[first:end] for name, array in arrays.items()})

    def _on_device(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arrays with consecutive indices of coplanar groups, and flags as int32."""
        result = dict(arrays)
        if "coplanar_groups" in result:
            ids, group_ids = result["coplanar_groups"], self._group_ids
            dense = np.searchsorted(group_ids, ids).astype(np.int32)
            # in a damaged store, chunks without coplanar groups may have ids
            result["coplanar_groups"] = np.where(np.isin(ids, group_ids), dense, np.int32(-1))
        if "boxes" in result:
            result["boxes"] = result["boxes"].astype(np.int32)
        return result
