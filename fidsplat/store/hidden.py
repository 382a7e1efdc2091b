"""What of a scene a view does not show although it lies in the picture, as other splats hide it: it is not
drawn, nor read. The picture is bit for bit that of all (fidsplat/backends/ends.py).

A view is drawn of some of what lies in it, those nodes that the last view did not find hidden, or the
nearest; then all others are held against the ends of its tiles. If each is hidden, the picture is done; else
those that are not are added, and it is drawn again. So along a path one time mostly does.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

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
_SMALL = 16
"""but a smaller part of them than this says little"""
_RESTS = 16
"""views that are not tried after one of which little was hidden"""
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
        return whole.drawn_of(_without(whole.nodes, whole.hidden(ends)))

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
            if not any(each.any() for each in missing):
                return band, images
            images = None  # its buffers are free for the next
            enough = band.count > whole.count // _SMALL
            if enough and band.count + whole.count_of(missing) > _FUTILE * whole.count:
                break
            more = _nearest(whole, missing, max(_FIRST, int(_GROWTH * band.count)))
            band = whole.drawn_of(
                tuple(a | b for a, b in zip(_without(band.nodes, behind), more, strict=True))
            )
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
    common. Only a guess: wider by a tile, and further by how far the camera has moved."""
    if (last.width, last.height, last.parallel) != (view.width, view.height, view.parallel):
        return None
    rows, columns = ends.depths.shape
    y, x = np.meshgrid(
        (np.arange(rows) + 0.5) * ends.tile[0], (np.arange(columns) + 0.5) * ends.tile[1], indexing="ij"
    )
    depths = ends.depths
    if view.raster is None and not view.parallel:
        ahead = np.stack(
            [(x - view.center_x) / view.focal_x, (y - view.center_y) / view.focal_y, np.ones_like(x)], -1
        )
        then = ahead @ view.rotation @ last.rotation.T
        with np.errstate(divide="ignore", invalid="ignore"):
            across = (then[..., 0] / then[..., 2] * last.focal_x + last.center_x) / ends.tile[1]
            down = (then[..., 1] / then[..., 2] * last.focal_y + last.center_y) / ends.tile[0]
        inside = (then[..., 2] > 0) & (across >= 0) & (across < columns) & (down >= 0) & (down < rows)
        if inside.mean() < 0.5:
            return None
        column = np.clip(np.nan_to_num(across), 0, columns - 1).astype(int)
        row = np.clip(np.nan_to_num(down), 0, rows - 1).astype(int)
        depths = np.where(then[..., 2] > 0, depths[row, column], np.inf)
    moved = float(np.linalg.norm(view.rotation.T @ view.translation - last.rotation.T @ last.translation))
    wide = np.pad(depths, 1, mode="edge")
    wide = np.maximum(np.maximum(wide[:-2], wide[1:-1]), wide[2:])
    wide = np.maximum(np.maximum(wide[:, :-2], wide[:, 1:-1]), wide[:, 2:])
    return replace(ends, depths=(wide + moved).astype(np.float32))
