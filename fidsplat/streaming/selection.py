"""What of stores and of splats beside them a view is drawn of: the chunks that it may see, in the order of
the whole, so that the picture is bit for bit that of all splats in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from fidsplat.backends.chunk_cache import Chunk
from fidsplat.backends.coplanar_groups import PlaneTable
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.capture.quality import Quality
from fidsplat.effects import FeatureSet
from fidsplat.splats.cloud import SplatCloud
from fidsplat.store.layout import MOST_SPLATS
from fidsplat.store.store import Store
from fidsplat.store.subset import StorePart, colors_of, joined
from fidsplat.streaming.frustum_culling import Boxes, in_frustum, projected_sizes
from fidsplat.streaming.occlusion_test import minimum_keys, occluded
from fidsplat.streaming.subchunks import Pieces, PiecesOf
from fidsplat.util.errors import InputError

KEPT_BYTES = 2 * 2**30
"""of chunks that were made for a view and are kept for the next, where the files do not hold them as they are
drawn"""


Pixels = float | tuple[tuple[float, ...], ...]
"""samples: how small cells are that need not be told apart; one size for all, or one for each level of each
store"""


Nodes = tuple[np.ndarray, ...]
"""of each store which of its nodes, (places * nodes,) bool"""


@dataclass(frozen=True)
class Selection:
    """What views are drawn of: numbers of each store's nodes, in the order of their splats."""

    nodes: tuple[tuple[int, ...], ...]
    rows: tuple[tuple[tuple[int, int], ...], ...] | None = None
    """of each of these the first row and how many; None: all of each node"""

    @staticmethod
    def of(nodes: Nodes) -> Selection:
        """Of some of all nodes."""
        return Selection(tuple(tuple(np.flatnonzero(each).tolist()) for each in nodes))

    @staticmethod
    def of_pieces(pieces: Sequence[Pieces]) -> Selection:
        """Of pieces of nodes."""
        return Selection(
            tuple(tuple(each.nodes.tolist()) for each in pieces),
            tuple(tuple(zip(each.first.tolist(), each.rows.tolist(), strict=True)) for each in pieces),
        )

    def __len__(self) -> int:
        return sum(len(set(each)) for each in self.nodes)


class Streamed:
    """Stores, then other splats, as one scene of which views see parts.

    Its traits are those of the whole. Threads may share one.
    """

    def __init__(self, stores: Sequence[Store], beside: SplatCloud | None = None) -> None:
        self.stores = tuple(stores)
        self.beside = SplatCloud.empty() if beside is None else beside
        self.origin = self.stores[0].origin
        """(3,) float64 metres: the world's position of the means' zero"""
        whole = [*self.stores, self.beside] if len(self.beside) else list(self.stores)
        self.sh_degree = max(max(part.sh_degree for part in whole), -1)
        if self.sh_degree == 0:
            self.sh_degree = -1
        self.has_planes = any(part.has_planes for part in whole)
        kinds = {part.footprint for part in whole if len(part)} or {"gaussian"}
        self.footprint = kinds.pop() if len(kinds) == 1 else "mixed"
        thick = {part.ellipsoids for part in whole if len(part)} or {"none"}
        self.ellipsoids = thick.pop() if len(thick) == 1 else "some"
        if len(self) > MOST_SPLATS:
            raise InputError(f"{len(self):,} splats are too many: a scene has at most {MOST_SPLATS:,}")
        self._kept: OrderedDict[tuple[int, int], dict[str, np.ndarray]] = OrderedDict()
        self._kept_bytes, self._lock = 0, threading.Lock()
        self._chunks_of: dict[tuple[int, bool], dict[int, Chunk]] = {}
        """of each store that were asked for, moved or not, by their numbers"""

    def __len__(self) -> int:
        return sum(map(len, self.stores)) + len(self.beside)

    @property
    def content(self) -> tuple:
        """What tells it from every other scene: of stores not their splats but their identities."""
        return (*(store.identity for store in self.stores), self.beside)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Axis-aligned box (min (3,), max (3,)) float64, world, around all splats, as that of a cloud."""
        boxes = [part.bounds() for part in (*self.stores, self.beside) if len(part)]
        if not boxes:
            raise InputError("a scene without splats has no bounds")
        low, high = zip(*boxes, strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def cloud(self) -> SplatCloud:
        """All splats in one cloud."""
        if len(self.stores) == 1 and not len(self.beside):
            return self.stores[0].cloud()
        return self.part(self.everything())

    def everything(self) -> Selection:
        """All chunks, and no node that stands for others."""
        every = (np.flatnonzero(np.tile(store.nodes["level"] == 0, store.places)) for store in self.stores)
        return Selection(tuple(tuple(numbers.tolist()) for numbers in every))

    def pixels_of(self, *qualities: Quality) -> Pixels:
        """How small [samples] cells must be not to be told apart, by the `detail_error` of qualities; the one
        that needs most decides. 0: exact.

        Raises:
            InputError: an error is allowed, but what levels of detail cost a store was not measured.
        """
        if not all(quality.detail_error for quality in qualities):
            return 0.0
        each = ([store.pixels_of(quality) for quality in qualities] for store in self.stores)
        return tuple(tuple(np.min(limits, axis=0).tolist()) for limits in each)

    def select(self, views: Sequence[View], features: FeatureSet, pixels: Pixels = 0.0) -> Selection:
        """What these views see. pixels: cells smaller than so many samples need not be told apart; 0: exactly
        the scene itself."""
        return Selection.of(self.seen(views, features, pixels))

    def seen(self, views: Sequence[View], features: FeatureSet, pixels: Pixels = 0.0) -> Nodes:
        """As `select`."""
        chosen = []
        for number, store in enumerate(self.stores):
            own = pixels[number] if isinstance(pixels, tuple) else (pixels,) * (store.levels + 1)
            chosen.append(_chosen(store, self._boxes(number), views, features, np.array(own)))
        return tuple(chosen)

    def least_keys(self, view: View, features: FeatureSet) -> Nodes:
        """Of each store's nodes (n,) metres: below the depths at which a view sorts their splats."""
        return tuple(minimum_keys(view, features, self._boxes(k)) for k in range(len(self.stores)))

    def hidden(self, view: View, features: FeatureSet, ends: TerminationDepths) -> Nodes:
        """The nodes of which nothing can show in a picture whose tiles end there."""
        made = []
        for number, store in enumerate(self.stores):
            reach = np.tile(store.nodes["reach"].astype(np.float64), store.places)
            # what stands on planes is in every picture
            made.append(occluded(view, features, self._boxes(number), reach, ends) & ~_pinned(store))
        return tuple(made)

    def pieces(self, nodes: Nodes) -> list[Pieces]:
        """Those of some nodes of each store."""
        every = zip(self._pieces, nodes, strict=True)
        return [pieces.of(np.flatnonzero(mask)) for pieces, mask in every]

    @cached_property
    def _pieces(self) -> list[PiecesOf]:
        return [PiecesOf(store, store.origin - self.origin, _pinned(store)) for store in self.stores]

    @cached_property
    def node_counts(self) -> Nodes:
        """Splats of each store's nodes."""
        return tuple(np.tile(store.nodes["count"].astype(np.int64), store.places) for store in self.stores)

    def part(self, selection: Selection) -> StorePart:
        """The splats of a selection."""
        parts = [self._chunk(number, node) for number, nodes in enumerate(selection.nodes) for node in nodes]
        if len(self.beside) or not parts:
            parts.append(self._beside)
        return StorePart.of(joined(parts), self)

    def ids(self, selection: Selection) -> np.ndarray:
        """Indices in the whole (n,) int32 of the splats of a selection; -1 of those that stand for others."""
        made, first = [np.empty(0, np.int32)], 0
        for number, (store, nodes) in enumerate(zip(self.stores, selection.nodes, strict=True)):
            numbers = np.array(nodes, np.int64)
            begins, counts = store.first_of(numbers), store.counts(numbers)
            if selection.rows is not None:
                own_rows = np.array(selection.rows[number], np.int64).reshape(-1, 2)
                begins, counts = np.where(begins < 0, -1, begins + own_rows[:, 0]), own_rows[:, 1]
            for at, count in zip(begins, counts, strict=True):
                own = np.full(count, -1) if at < 0 else np.arange(first + at, first + at + count)
                made.append(own.astype(np.int32))
            first += len(store)
        made.append(np.arange(first, first + len(self.beside), dtype=np.int32))
        return np.concatenate(made)

    def count_of(self, selection: Selection) -> int:
        """Splats of a selection."""
        each = zip(self.stores, selection.nodes, strict=True)
        chosen = sum(int(store.counts(np.array(nodes, np.int64)).sum()) for store, nodes in each)
        return chosen + len(self.beside)

    @property
    def largest_chunk(self) -> int:
        """Splats of the largest node; those beside are taken in as large parts."""
        return max(int(store.nodes["count"].max(initial=1)) for store in self.stores)

    @property
    def planes(self) -> PlaneTable | None:
        """Of all splats that are printed on planes: those are in every part."""
        return self._plane_table if self.has_planes else None

    def chunks(self, selection: Selection, places: bool) -> list[Chunk]:
        """The splats of a selection for a device that keeps them. places: whether it moves chunks to their
        places."""
        made = []
        for number, (store, nodes) in enumerate(zip(self.stores, selection.nodes, strict=True)):
            moved = places and self._may_move(store)
            known = self._chunks_of.setdefault((number, moved), {})
            for place, node in enumerate(nodes):
                if (chunk := known.get(node)) is None:
                    chunk = known[node] = self._chunk_of(number, node, moved)
                if selection.rows is not None:
                    first, count = selection.rows[number][place]
                    chunk = replace(chunk, first=first, count=count)
                made.append(chunk)
        most, count = self.largest_chunk, len(self.beside)
        for first in range(0, count if made else max(count, 1), most):
            end = min(first + most, count)
            made.append(Chunk(("beside", first), end - first, partial(self._part_beside, first, end)))
        return made

    def distinct(self, places: bool) -> int:
        """As `WholeScene`."""
        each = (
            len(store.nodes) * (1 if places and self._may_move(store) else store.places)
            for store in self.stores
        )
        return sum(each) + -(-len(self.beside) // self.largest_chunk)

    def _may_move(self, store: Store) -> bool:
        """Whether a device may move a store's chunks to their places: harmonics turn with their splats, and
        means of another origin are rounded once more."""
        return store.poses is not None and self.sh_degree < 0 and not (store.origin - self.origin).any()

    def _chunk_of(self, number: int, node: int, moved: bool) -> Chunk:
        store = self.stores[number]
        place, own = divmod(node, len(store.nodes))
        key = (number, own if moved else node)
        pose = store.pose_rows[place] if moved else None
        return Chunk(key, int(store.nodes["count"][own]), partial(self._laid_out, key, moved), pose)

    def _part_beside(self, first: int, end: int) -> dict[str, np.ndarray]:
        return self._on_device({name: array[first:end] for name, array in self._beside.items()})

    def _laid_out(self, key: tuple[int, int], unplaced: bool) -> dict[str, np.ndarray]:
        """The arrays of a chunk on a device."""
        if not unplaced:
            return self._on_device(self._chunk(*key))
        number, node = key
        given = self.stores[number].load(node, placed=False)
        return self._on_device(self._fitted(given, self._planes_before[number]))

    def _on_device(self, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        made = dict(arrays)
        if "planes" in made:
            known = np.append(self._plane_ids, np.iinfo(np.int32).max)
            dense = np.searchsorted(known, made["planes"]).astype(np.int32)
            made["planes"] = np.where(made["planes"] < 0, np.int32(-1), dense)
        if "boxes" in made:
            made["boxes"] = made["boxes"].astype(np.int32)
        return made

    @cached_property
    def _plane_table(self) -> PlaneTable:
        return PlaneTable(self._on_planes)

    @cached_property
    def _on_planes(self) -> StorePart:
        """The chunks that every picture has, and the splats beside."""
        none = (np.flatnonzero(_pinned(store)) for store in self.stores)
        return self.part(Selection(tuple(tuple(numbers.tolist()) for numbers in none)))

    @cached_property
    def _plane_ids(self) -> np.ndarray:
        ids = self._on_planes.planes
        assert ids is not None
        return np.unique(ids[ids >= 0])

    def fetch(self, selection: Selection) -> None:
        """Bring what a selection needs into memory."""
        for number, nodes in enumerate(selection.nodes):
            for node in nodes:
                for array in self._chunk(number, node).values():
                    # a byte of each page is enough
                    array.reshape(-1).view(np.uint8)[:: 1 << 12].max(initial=0)

    def _chunk(self, number: int, node: int) -> dict[str, np.ndarray]:
        store, key = self.stores[number], (number, node)
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        made = self._fitted(self._brought(store.load(node), store.origin), self._planes_before[number])
        own = sum(array.nbytes for array in made.values() if array.base is None)
        if own * 4 >= sum(array.nbytes for array in made.values()):
            with self._lock:
                self._kept_bytes += 0 if key in self._kept else own
                self._kept[key] = made
                while self._kept_bytes > KEPT_BYTES and len(self._kept) > 1:
                    _, gone = self._kept.popitem(last=False)
                    self._kept_bytes -= sum(a.nbytes for a in gone.values() if a.base is None)
        return made

    @cached_property
    def _planes_before(self) -> list[int]:
        """What each store's ids of planes are raised by, and last those of the splats beside."""
        made = [0]
        for store in self.stores:
            made.append(made[-1] + store.last_plane() + 1)
        return made

    @cached_property
    def _beside(self) -> dict[str, np.ndarray]:
        cloud = self.beside
        arrays = {name: getattr(cloud, name) for name in ("means", "quats", "scales", "opacities", "labels")}
        arrays = self._brought(arrays, cloud.origin)
        some = {"sh": cloud.sh, "colors": cloud.colors, "planes": cloud.planes}
        some |= {"thickness": cloud.thickness, "boxes": cloud.boxes}
        arrays |= {name: array for name, array in some.items() if array is not None}
        return self._fitted(arrays, self._planes_before[-1])

    def _boxes(self, number: int) -> Boxes:
        """Boxes of a store's nodes as `Store.boxes`, from the origin of the whole."""
        store = self.stores[number]
        move = store.origin - self.origin

        def boxes(sigmas: float) -> tuple[np.ndarray, np.ndarray]:
            low, high = store.boxes(sigmas)
            return low + move, high + move

        return boxes

    def _brought(self, given: dict[str, np.ndarray], origin: np.ndarray) -> dict[str, np.ndarray]:
        """Splats relative to an origin (3,) float64, relative to that of the whole."""
        move = origin - self.origin
        if not move.any():
            return given
        return given | {"means": (given["means"] + move).astype(np.float32)}

    def _fitted(self, given: dict[str, np.ndarray], first_plane: int) -> dict[str, np.ndarray]:
        """Splats with the arrays that the whole has."""
        count = len(given["means"])
        made = {name: given[name] for name in ("means", "quats", "scales", "opacities", "labels")}
        made |= colors_of(given, self.sh_degree)
        if self.has_planes:
            ids = given.get("planes", np.full(count, -1, np.int32))
            made["planes"] = np.where(ids >= 0, ids + np.int32(first_plane), np.int32(-1))
        if self.ellipsoids != "none":
            made["thickness"] = given.get("thickness", np.zeros(count, np.float32))
        if self.footprint != "gaussian":
            made["boxes"] = given.get("boxes", np.zeros(count, bool))
        return made


def _pinned(store: Store) -> np.ndarray:
    """(n,) bool: the nodes with splats on planes, which every picture has."""
    nodes = store.nodes
    return np.tile((nodes["level"] == 0) & (nodes["first"] >= store.header.pinned), store.places)


def _chosen(
    store: Store, boxes: Boxes, views: Sequence[View], features: FeatureSet, pixels: np.ndarray
) -> np.ndarray:
    """(n,) bool: the nodes of a store that views are drawn of. boxes: as `Store.boxes`, from the origin that
    views see it from."""
    if not len(store.nodes):
        return np.zeros(0, bool)
    nodes, places = store.nodes, store.places
    level = np.tile(nodes["level"], places)
    reach = np.tile(nodes["reach"].astype(np.float64), places)
    visible = np.zeros(len(level), bool)
    for view in views:
        visible |= in_frustum(view, features, boxes, reach)
    pinned = _pinned(store)
    if not pixels.any():
        return (visible | pinned) & (level == 0)
    parents = np.tile(nodes["parent"].astype(np.int64), places)
    parents = np.where(parents >= 0, parents + np.repeat(np.arange(places), len(nodes)) * len(nodes), -1)
    edges = np.tile(nodes["size"].astype(np.float64), places)
    refined = np.zeros(len(level), bool)
    for view in views:
        refined |= projected_sizes(view, boxes, edges) > pixels[level]
    reached = parents < 0
    for above in range(int(level.max()), 0, -1):
        children = np.flatnonzero((level == above - 1) & (parents >= 0))
        reached[children] = (reached & refined & visible)[parents[children]]
    return ((reached & visible) | pinned) & (~refined | (level == 0))
