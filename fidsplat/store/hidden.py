"""What of a scene a view does not show although it lies in the picture, as other splats hide it: it is not
drawn, nor read. The picture is bit for bit that of all (fidsplat/backends/ends.py).

A view is drawn of some of what lies in it, those nodes that the last view did not find hidden, or the
nearest; then all others are held against the ends of its tiles. If each is hidden, the picture is done; else
those that are not are added, and it is drawn again. So along a path one time mostly does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from fidsplat.backends.base import Images
from fidsplat.backends.ends import TileEnds
from fidsplat.backends.view import View
from fidsplat.store.bands import Band
from fidsplat.store.streamed import Nodes

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
_ROUNDS = 12
"""drawn as often as that, a view is drawn of all that may show"""


class Hidden:
    """What the last view has taught about what hides what."""

    def __init__(self) -> None:
        self._last: tuple[View, TileEnds] | None = None
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
        if ends is None:
            return whole.drawn_of(_nearest(whole, whole.nodes, _FIRST))
        return whole.drawn_of(_without(whole.nodes, whole.hidden(ends))).cut_to(ends)

    def drawn(
        self,
        whole: Band,
        fits: Callable[[Band], bool],
        draw: Callable[[Band], tuple[Images, TileEnds]],
    ) -> tuple[Band, Images] | None:
        """A view drawn of what is not hidden, and its picture. None where it is to be drawn of all that it
        sees: little is hidden, or what is not does not fit."""
        band = self.begun(whole)
        for _ in range(_ROUNDS):
            if not fits(band):
                break
            images, ends = draw(band)
            self._last = whole.view, ends
            behind = whole.hidden(ends)
            missing = _without(band.missing, behind)
            if not (any(each.any() for each in missing) or band.lacks_pieces(ends)):
                self._rest = _RESTS if band.count > _FUTILE * whole.count else 0
                return band, images
            images = None  # its buffers are free for the next
            left = band.count + whole.count_of(missing)
            more = _nearest(whole, missing, max(_FIRST, int(_GROWTH * band.count)))
            shown = zip(_without(band.nodes, behind), more, strict=True)
            band = whole.drawn_of(tuple(a | b for a, b in shown)).cut_to(ends)
            if left > _FUTILE * whole.count and band.count > max(whole.count // _SMALL, _CHEAP):
                break
        self._rest = _RESTS
        return None


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


def _carried(last: View, ends: TileEnds, view: View) -> TileEnds | None:
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
