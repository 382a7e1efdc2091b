"""Row bands: a frame that does not fit on the device is rendered in bands of rows, each from its visible
chunks. If a band cannot be split further, the device projects its splats in slices."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from fidsplat.backends.interface import DeviceCloud, Images
from fidsplat.backends.ranges import split_by_cost
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.store.chunked_splats import CellSizes, ChunkedSplats, NodeMasks, Selection
from fidsplat.store.subchunks import Subchunks
from fidsplat.streaming.frustum_culling import in_frustum
from fidsplat.streaming.level_of_detail import visible_nodes
from fidsplat.streaming.occlusion_test import contributing_tiles, occluded, occluded_nodes

_MIN_ROWS = 16
"""minimum height of a band [px]"""
_MAX_OVERLAP = 1.6
"""a band is split if its halves together have at most this many times its splats; with a fisheye lens, each
half may need all splats"""


@dataclass(frozen=True)
class BandData:
    """A band of rows on the device: its splats, or its images if it is already rendered."""

    rows: tuple[int, int]
    """pixels [first, end)"""
    view: View
    data: DeviceCloud | None
    scene_indices: Callable[[], np.ndarray]
    """function that returns the indices in the scene of its splats, (n,) int32"""
    images: Images | None = None


@dataclass(frozen=True)
class Band:
    """A band of rows of a view, and the chunks from which it is rendered."""

    scene: ChunkedSplats
    full_view: View
    features: FeatureSet
    cell_sizes: CellSizes
    rows: tuple[int, int]
    """pixels [first, end)"""
    subset: NodeMasks | None = None
    """nodes (chunks, also of levels of detail) from which the band is rendered; None: all visible ones"""
    subchunks: tuple[tuple[Subchunks, np.ndarray], ...] | None = None
    """subchunks of these nodes, and a mask (k,) bool of those from which it is rendered; None: all"""

    @staticmethod
    def of(scene: ChunkedSplats, view: View, features: FeatureSet, cell_sizes: CellSizes) -> Band:
        first, end = view.sample_rows or (0, view.height)
        return Band(scene, view, features, cell_sizes, (first // view.samples, end // view.samples))

    def with_rows(self, first: int, end: int) -> Band:
        """A band of other rows of the same view, rendered from all nodes that are visible in it."""
        return replace(self, rows=(first, end), subset=None, subchunks=None)

    def with_nodes(self, nodes: NodeMasks) -> Band:
        """This band, rendered from some of its visible nodes."""
        return self._with_cache(replace(self, subset=nodes, subchunks=None))

    def _with_cache(self, band: Band) -> Band:
        if "visible" in self.__dict__:
            band.__dict__["visible"] = self.visible
        return band

    def without_occluded(self, termination: TerminationDepths) -> Band:
        """This band without occluded nodes and subchunks."""
        occluded = self.occluded(termination)
        nodes = tuple(a & ~b for a, b in zip(self.nodes, occluded, strict=True))
        return self.with_nodes(nodes).without_occluded_subchunks(termination)

    def without_occluded_subchunks(self, termination: TerminationDepths) -> Band:
        """This band, rendered only from the subchunks of its nodes that can contribute."""
        parts = self.scene.subchunks(self.nodes)
        masked = tuple((part, self._can_contribute(part, termination)) for part in parts)
        return self._with_cache(replace(self, subchunks=masked))

    def missing_subchunks(self, termination: TerminationDepths, missing: NodeMasks) -> list[Subchunks]:
        """Subchunks that can contribute but were not rendered, of the band's nodes and of missing nodes."""
        candidates = [(part, ~rendered) for part, rendered in self.subchunks or ()]
        candidates += [(part, np.array(True)) for part in self.scene.subchunks(missing)]
        parts = [part.only(self._can_contribute(part, termination) & mask) for part, mask in candidates]
        return [part for part in parts if len(part.nodes)]

    def contributing_tiles(
        self, subchunks: Sequence[Subchunks], termination: TerminationDepths
    ) -> np.ndarray:
        """(rows, columns) bool: tiles to which subchunks can contribute."""
        tiles = np.zeros(termination.depths.shape, bool)
        for part in subchunks:
            tiles |= contributing_tiles(
                self.view, self.features, part.bounding_boxes, part.max_sigma, termination
            )
        return tiles

    def _can_contribute(self, subchunks: Subchunks, termination: TerminationDepths) -> np.ndarray:
        """(k,) bool: subchunks that are pinned, or in the frustum and not occluded."""
        if not len(subchunks.nodes):
            return np.zeros(0, bool)
        visible = in_frustum(self.view, self.features, subchunks.bounding_boxes, subchunks.max_sigma)
        visible &= ~occluded(
            self.view, self.features, subchunks.bounding_boxes, subchunks.max_sigma, termination
        )
        return visible | subchunks.pinned

    @cached_property
    def view(self) -> View:
        """The view restricted to this band."""
        first, end = (row * self.full_view.samples for row in self.rows)
        if (first, end) == (0, self.full_view.height):
            return self.full_view
        return replace(self.full_view, sample_rows=(first, end))

    @cached_property
    def visible(self) -> NodeMasks:
        """All visible nodes."""
        return visible_nodes(self.scene, [self.view], self.features, self.cell_sizes)

    @property
    def nodes(self) -> NodeMasks:
        """The nodes from which the band is rendered."""
        return self.visible if self.subset is None else self.subset

    @property
    def missing(self) -> NodeMasks:
        """Visible nodes from which the band is not rendered."""
        return tuple(mask & ~rendered for mask, rendered in zip(self.visible, self.nodes, strict=True))

    def occluded(self, termination: TerminationDepths) -> NodeMasks:
        """Nodes of the scene that are occluded in this band."""
        return occluded_nodes(self.scene, self.view, self.features, termination)

    @cached_property
    def selection(self) -> Selection:
        """Chunks, or rows of chunks, from which the band is rendered."""
        if self.subchunks is None:
            return Selection.of(self.nodes)
        return Selection.of_subchunks([part.only(rendered) for part, rendered in self.subchunks])

    @cached_property
    def count(self) -> int:
        """Number of splats from which the band is rendered."""
        if self.subchunks is None:
            return self.count_of(self.nodes) + len(self.scene.in_memory)
        counts = (int(part.rows[rendered].sum()) for part, rendered in self.subchunks)
        return sum(counts) + len(self.scene.in_memory)

    def count_of(self, nodes: NodeMasks) -> int:
        """Number of splats of nodes."""
        masked = zip(self.scene.node_counts, nodes, strict=True)
        return sum(int(counts[mask].sum()) for counts, mask in masked)

    @property
    def halves(self) -> list[Band]:
        """The upper and the lower half of the band; empty if the band cannot be split."""
        first, end = self.rows
        middle = (first + end) // 2
        if end - first < 2 * _MIN_ROWS or self.full_view.sub_frames:
            return []
        halves = [self.with_rows(first, middle), self.with_rows(middle, end)]
        return halves if sum(half.count for half in halves) <= _MAX_OVERLAP * self.count else []


class BandSplitter:
    """Splits views into bands that fit on the device, starting with the bands of the previous view."""

    def __init__(self) -> None:
        self._borders: dict[tuple[int, int], list[int]] = {}
        """first rows of the bands of the previous view, and the end, by the view's rows"""
        self._capacity = 0
        """largest number of splats of a band that fits"""

    def split(self, full: Band, fits: Callable[[Band], bool]) -> Iterator[Band]:
        """Bands from the top, which fit or cannot be split; `fits` is called immediately before each."""
        remaining = [full.with_rows(*rows) for rows in pairwise(self._borders.get(full.rows, full.rows))]
        bands: list[Band] = []
        while remaining:
            band = remaining.pop(0)
            band_fits = fits(band)
            if not band_fits and (halves := band.halves):
                self._capacity = min(self._capacity, band.count // 2)
                remaining[:0] = halves
                continue
            if band_fits:
                self._capacity = max(self._capacity, band.count)
            bands.append(band)
            yield band
        counts = np.array([band.count for band in bands])
        firsts = [bands[first].rows[0] for first, _, _ in split_by_cost(counts, self._capacity)]
        self._borders = {full.rows: [*firsts, bands[-1].rows[1]]}
