"""Views that are drawn of more than fits a device at once: band after band of their rows, each of what it
sees."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from fidsplat.backends.interface import Images, ResidentData
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet
from fidsplat.streaming.frustum_culling import in_frustum
from fidsplat.streaming.occlusion_test import contributing_tiles, occluded
from fidsplat.streaming.selection import Nodes, Pixels, Selection, Streamed
from fidsplat.streaming.subchunks import Pieces

_LEAST_ROWS = 16
"""pixels: what a device lists together at least"""
_FUTILE = 1.6
"""times as many splats as both halves see of a band are not worth cutting it: of a fisheye's, say, each is
drawn of all"""


@dataclass(frozen=True)
class PartOfView:
    """A band of a view on the device."""

    rows: tuple[int, int]
    """of pixels, [first, end)"""
    view: View
    data: ResidentData | None
    """None if it is drawn already"""
    ids: Callable[[], np.ndarray]
    """the indices in the whole (n,) int32 of its splats"""
    images: Images | None = None
    """if it is"""


@dataclass(frozen=True)
class Band:
    """Rows of pixels of a view."""

    scene: Streamed
    whole: View
    features: FeatureSet
    pixels: Pixels
    """as of `Streamed.select`"""
    rows: tuple[int, int]
    some: Nodes | None = None
    """all that it is drawn of, if that is not all that it sees"""
    pieces: tuple[tuple[Pieces, np.ndarray], ...] | None = None
    """of these the pieces, and which of them (k,) bool it is drawn of; None: all"""

    @staticmethod
    def of(scene: Streamed, view: View, features: FeatureSet, pixels: Pixels) -> Band:
        """All rows that are wanted of a view."""
        first, end = view.band or (0, view.height)
        return Band(scene, view, features, pixels, (first // view.samples, end // view.samples))

    def within(self, first: int, end: int) -> Band:
        """Fewer of its rows, drawn of all that they see."""
        return replace(self, rows=(first, end), some=None, pieces=None)

    def drawn_of(self, some: Nodes) -> Band:
        """It, drawn of some of what it sees."""
        return self._kept(replace(self, some=some, pieces=None))

    def _kept(self, made: Band) -> Band:
        if "seen" in self.__dict__:
            made.__dict__["seen"] = self.seen  # a cached property
        return made

    def cut_to(self, ends: TerminationDepths) -> Band:
        """It, drawn of those pieces alone that may show where its tiles end there."""
        pieces = self.scene.pieces(self.nodes)
        return self._kept(replace(self, pieces=tuple((each, self._needed(each, ends)) for each in pieces)))

    def lacking(self, ends: TerminationDepths, missing: Nodes) -> list[Pieces]:
        """The pieces that may show where tiles end there and that it was not drawn of: of its nodes, and of
        some that are missing."""
        own = [each.only(self._needed(each, ends) & ~drawn) for each, drawn in self.pieces or ()]
        others = (each.only(self._needed(each, ends)) for each in self.scene.pieces(missing))
        return [each for each in (*own, *others) if len(each.nodes)]

    def shown(self, pieces: Sequence[Pieces], ends: TerminationDepths) -> np.ndarray:
        """(rows, columns) bool: the tiles that end there in which pieces may show."""
        made = np.zeros(ends.depths.shape, bool)
        for each in pieces:
            made |= contributing_tiles(self.view, self.features, each.boxes, each.reach, ends)
        return made

    def ended(self, ends: TerminationDepths) -> Band:
        """It, drawn of what may show where its tiles end there."""
        hidden = self.hidden(ends)
        return self.drawn_of(tuple(a & ~b for a, b in zip(self.nodes, hidden, strict=True))).cut_to(ends)

    def _needed(self, pieces: Pieces, ends: TerminationDepths) -> np.ndarray:
        """(k,) bool: which pieces may show where tiles end there."""
        if not len(pieces.nodes):
            return np.zeros(0, bool)
        shows = in_frustum(self.view, self.features, pieces.boxes, pieces.reach)
        shows &= ~occluded(self.view, self.features, pieces.boxes, pieces.reach, ends)
        return shows | pieces.always

    @cached_property
    def view(self) -> View:
        """That wants these rows alone."""
        first, end = (row * self.whole.samples for row in self.rows)
        return (
            self.whole if (first, end) == (0, self.whole.height) else replace(self.whole, band=(first, end))
        )

    @cached_property
    def seen(self) -> Nodes:
        """All nodes that it may see."""
        return self.scene.seen([self.view], self.features, self.pixels)

    @property
    def nodes(self) -> Nodes:
        """Those that it is drawn of."""
        return self.seen if self.some is None else self.some

    @property
    def missing(self) -> Nodes:
        """Those that it may see and is not drawn of."""
        return tuple(each & ~own for each, own in zip(self.seen, self.nodes, strict=True))

    def hidden(self, ends: TerminationDepths) -> Nodes:
        """The nodes of which it shows nothing where its tiles end there."""
        return self.scene.hidden(self.view, self.features, ends)

    def least_keys(self) -> Nodes:
        """As that of `Streamed`."""
        return self.scene.least_keys(self.view, self.features)

    @cached_property
    def selection(self) -> Selection:
        """What it is drawn of."""
        if self.pieces is None:
            return Selection.of(self.nodes)
        return Selection.of_pieces([pieces.only(drawn) for pieces, drawn in self.pieces])

    @cached_property
    def count(self) -> int:
        """Splats of that."""
        if self.pieces is None:
            return self.count_of(self.nodes) + len(self.scene.beside)
        return sum(int(each.rows[drawn].sum()) for each, drawn in self.pieces) + len(self.scene.beside)

    def count_of(self, nodes: Nodes) -> int:
        """Splats of some nodes."""
        return sum(int(n[own].sum()) for n, own in zip(self.scene.node_counts, nodes, strict=True))

    @property
    def halves(self) -> list[Band]:
        """Bands of half as many rows; none, if that is of no use."""
        first, end = self.rows
        middle = (first + end) // 2
        if end - first < 2 * _LEAST_ROWS or self.whole.shots:
            return []
        made = [self.within(first, middle), self.within(middle, end)]
        return made if sum(half.count for half in made) <= _FUTILE * self.count else []


class Bands:
    """Where views are cut, from view to view: what the last was cut into is where the next begins."""

    def __init__(self) -> None:
        self._cuts: dict[tuple[int, int], list[int]] = {}
        """by the rows that were wanted of the last view"""
        self._most = 0
        """splats that were drawn at once"""

    def cut(self, whole: Band, fits: Callable[[Band], bool]) -> Iterator[Band]:
        """Bands that each fit, from the top, or cannot be cut further. What fits is asked right before a band
        is given."""
        waiting = [whole.within(*rows) for rows in pairwise(self._cuts.get(whole.rows, whole.rows))]
        made: list[Band] = []
        while waiting:
            band = waiting.pop(0)
            fitting = fits(band)
            if not fitting and (halves := band.halves):
                self._most = min(self._most, band.count // 2)
                waiting[:0] = halves
                continue
            if fitting:
                self._most = max(self._most, band.count)
            made.append(band)
            yield band
        self._cuts = {whole.rows: self._joined(made)}

    def _joined(self, bands: list[Band]) -> list[int]:
        """The rows at which bands begin and the last ends: neighbours together, as far as so many splats
        fitted before."""
        cuts, splats = [bands[0].rows[0]], 0
        for band in bands:
            if splats and splats + band.count > self._most:
                cuts.append(band.rows[0])
                splats = 0
            splats += band.count
        return [*cuts, bands[-1].rows[1]]
