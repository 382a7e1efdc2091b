"""What of a scene a view does not show although it lies in the picture, as other splats hide it: it is not
drawn, nor read. The picture is bit for bit that of all (fidsplat/backends/termination_depth.py).

A view is drawn of some of what lies in it, those nodes that the last view did not find hidden, or the
nearest; then all others are held against the ends of its tiles. If each is hidden, the picture is done. If a
few are not, the tiles in which they may show are drawn again, of what may show there; if many are not, they
are added, and the whole is drawn again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from fidsplat.backends.interface import Images
from fidsplat.backends.termination_depth import TerminationDepths
from fidsplat.backends.view import View
from fidsplat.streaming.bands import Band
from fidsplat.streaming.selection import Nodes

LEAST = 1_000_000
"""splats: pictures of fewer are drawn without asking"""
_FIRST = 1_500_000
"""splats that the first view is begun with, and by which any grows at least"""
_GROWTH = 2.0
"""by how many times what was drawn it grows at most: what is added first may hide the rest"""
_FUTILE = 0.7
"""of a view's splats: where as many are not hidden, all are drawn"""
_SMALL, _CHEAP = 4, 4_000_000
"""but a smaller part of them than this, or so many splats, are drawn to find out"""
_RESTS = 16
"""views that are not tried after one of which little was hidden"""
_LOOKS, _SLACK = 4, 4.0
"""directions of a tile, across and down, in which the last view's ends are looked up; and by how many times
the way that the camera has moved they are taken to be further"""
_SOME = 2
"""what is missing is drawn by itself, in the tiles in which it may show, where that takes so many times fewer
splats than the whole picture"""
_ROUNDS = 12
"""drawn as often as that, a view is drawn of all that may show"""


class Hidden:
    """What the last view has taught about what hides what."""

    def __init__(self) -> None:
        self._last: tuple[View, TerminationDepths] | None = None
        self._rest = 0
        """views that are yet to be drawn without asking"""

    def expects(self, whole: Band, later: int = 0) -> bool:
        """Whether a view is worth asking, so many views later."""
        return whole.count >= LEAST and self._rest <= later

    def passed(self) -> None:
        """A view was drawn without asking."""
        self._rest = max(self._rest - 1, 0)

    def begun(self, whole: Band) -> Band:
        """What a view is drawn of first."""
        last = self._last
        ends = None if last is None else _carried(*last, whole.view)
        return whole.drawn_of(_nearest(whole, whole.nodes, _FIRST)) if ends is None else whole.ended(ends)

    def drawn(
        self,
        whole: Band,
        fits: Callable[[Band, int], bool],
        draw: Callable[[Band, int], tuple[Images, TerminationDepths]],
        take: Callable[[Images, Images, np.ndarray], None],
    ) -> tuple[list[Band], Images] | None:
        """A view drawn of what is not hidden: what it was drawn of, and its picture. None where it is to be
        drawn of all that it sees: little is hidden, or what is not does not fit.

        Args:
            fits, draw: are given the index of the first splat, by which others' come before.
            take: takes the tiles (rows, columns) bool of another picture into one.
        """
        bands, kept, tiles = [self.begun(whole)], None, np.array(True)
        for _ in range(_ROUNDS):
            band, before = bands[-1], sum(each.count for each in bands[:-1])
            if not fits(band, before):
                break
            images, ends = draw(band, before)
            if kept is not None:
                take(kept[0], images, tiles)
                images, ends = kept[0], kept[1].replaced(tiles, ends)
            self._last = whole.view, ends
            here = ends.within(tiles)
            missing = _without(band.missing, band.hidden(here))
            few = whole.count_of(missing) <= bands[0].count // _SOME
            lacking = band.lacking(here, missing) if few else []
            if few and not lacking:
                self._rest = _RESTS if bands[0].count > _FUTILE * whole.count else 0
                return bands, images
            if few and _whole_pixels(whole.view, ends):
                tiles = band.shown(lacking, here)
                again = whole.within(*_rows(tiles, whole, ends)).ended(ends.within(tiles))
                if again.count <= bands[0].count // _SOME:
                    bands, kept = [*bands, again], (images, ends)
                    continue
            images = kept = None  # its buffers are free for the next
            tiles, behind = np.array(True), whole.hidden(ends)
            missing = _without(bands[0].missing, behind)
            left = bands[0].count + whole.count_of(missing)
            more = _nearest(whole, missing, max(_FIRST, int(_GROWTH * bands[0].count)))
            shown = zip(_without(bands[0].nodes, behind), more, strict=True)
            bands = [whole.drawn_of(tuple(a | b for a, b in shown)).cut_to(ends)]
            if left > _FUTILE * whole.count and bands[0].count > max(whole.count // _SMALL, _CHEAP):
                break
        self._rest = _RESTS
        return None


def _rows(tiles: np.ndarray, whole: Band, ends: TerminationDepths) -> tuple[int, int]:
    """The rows of pixels [first, end) of a view in which some tiles lie."""
    rows, height = np.flatnonzero(tiles.any(axis=1)), ends.tile[0] // whole.view.samples
    return max(int(rows[0]) * height, whole.rows[0]), min((int(rows[-1]) + 1) * height, whole.rows[1])


def _whole_pixels(view: View, ends: TerminationDepths) -> bool:
    """Whether every pixel has its samples in one tile."""
    return not any(side % view.samples for side in ends.tile)


def _without(nodes: Nodes, others: Nodes) -> Nodes:
    return tuple(each & ~other for each, other in zip(nodes, others, strict=True))


def _nearest(whole: Band, nodes: Nodes, most: int) -> Nodes:
    """The nearest of some nodes, of about so many splats together; one at least."""
    depths = [depth[mask] for depth, mask in zip(whole.least_keys(), nodes, strict=True)]
    counts = [count[mask] for count, mask in zip(whole.scene.node_counts, nodes, strict=True)]
    order = np.argsort(np.concatenate(depths), kind="stable")
    kept = np.zeros(len(order), bool)
    before = np.cumsum(np.concatenate(counts)[order], dtype=np.int64) - np.concatenate(counts)[order]
    kept[order[before < most]] = True
    made, first = [], 0
    for mask in nodes:
        chosen, count = mask.copy(), int(np.count_nonzero(mask))
        chosen[mask] = kept[first : first + count]
        made.append(chosen)
        first += count
    return tuple(made)


def _carried(last: View, ends: TerminationDepths, view: View) -> TerminationDepths | None:
    """What the ends of a view's tiles may be, by those of the view before; None where the two have little in
    common. Only a guess: of what lay in the same directions, and further by what the camera has moved."""
    if (last.width, last.height, last.parallel) != (view.width, view.height, view.parallel):
        return None
    rows, columns = ends.depths.shape
    depths = ends.depths
    if view.raster is None and not view.parallel:
        depths, shares = np.full_like(depths, -np.inf), []
        within = (np.arange(_LOOKS) + 0.5) / _LOOKS
        for down, right in product(within, within):
            y, x = np.mgrid[0:rows, 0:columns]
            y, x = (y + down) * ends.tile[0], (x + right) * ends.tile[1]
            ahead = (x - view.center_x) / view.focal_x, (y - view.center_y) / view.focal_y, np.ones(x.shape)
            then = np.stack(ahead, -1) @ view.rotation @ last.rotation.T
            before = then[..., 2] > 0
            far = np.where(before, then[..., 2], 1.0)
            column = (then[..., 0] / far * last.focal_x + last.center_x) // ends.tile[1]
            row = (then[..., 1] / far * last.focal_y + last.center_y) // ends.tile[0]
            shares.append(before & (column >= 0) & (column < columns) & (row >= 0) & (row < rows))
            row, column = np.clip(row, 0, rows - 1).astype(int), np.clip(column, 0, columns - 1).astype(int)
            depths = np.maximum(depths, np.where(before, ends.depths[row, column], np.inf))
        if np.mean(shares) < 0.5:
            return None
    moved = float(np.linalg.norm(view.rotation.T @ view.translation - last.rotation.T @ last.translation))
    return replace(ends, depths=(depths + np.float32(_SLACK * moved)).astype(np.float32))
