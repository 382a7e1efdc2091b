"""What lies behind all that a picture shows: boxes of splats that are hidden need not be drawn.

A tile's list of splats is walked through by its sort keys, until all pixels of the tile are finished. The
device tells at which key that was, its end (kernels/opencl/part/tile_ends_*.cl). A splat whose key is larger
changes nothing in that tile: the list is the same up to its end, with or without it. So, of a picture that
was drawn of some splats: if each of the others has a larger key than the ends of all tiles that it can touch,
the picture has the bits of that of all splats. Nothing is assumed of transmittances, and nothing of the order
of pixels or outputs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from fidsplat.backends.frustum_culling import ROOM, Boxes, Extent, Turned, ewa_reach
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet

_RANGE = 3.33
"""standard deviations: out to sqrt(2 ln 255) a splat has depths of its own (kernels/opencl/slot/
compose_pixel.cl)"""


@dataclass(frozen=True)
class TileEnds:
    """Where the tiles of a picture were finished."""

    depths: np.ndarray
    """(rows, columns) float32 metres, as sort keys mean depth; infinite where more could still show"""
    tile: tuple[int, int]
    """rows and columns of samples in a tile"""

    def within(self, tiles: np.ndarray) -> TileEnds:
        """Where some tiles (rows, columns) bool were finished: in the others nothing shows."""
        return replace(self, depths=np.where(tiles, self.depths, np.float32(-np.inf)))

    def replaced(self, tiles: np.ndarray, other: TileEnds) -> TileEnds:
        """With the ends of some tiles (rows, columns) bool from another picture."""
        return replace(self, depths=np.where(tiles, other.depths, self.depths))

    @staticmethod
    def of_keys(keys: np.ndarray, tile: tuple[int, int]) -> TileEnds:
        """From the kernels' sortable keys (rows, columns) uint32, all bits set: not finished."""
        bits = np.where(keys & 0x80000000, keys ^ np.uint32(0x80000000), ~keys).astype(np.uint32)
        depths = bits.view(np.float32).copy()
        depths[(keys == 0xFFFFFFFF) | np.isnan(depths)] = np.inf
        return TileEnds(depths, tile)


@runtime_checkable
class GivesTileEnds(Protocol):
    """A backend with the effect `tile_ends`: what its pipelines for features that have it draw has this."""

    def tile_ends_of(self, images: object) -> TileEnds:
        """Where the tiles of a picture were finished; waits until it is drawn."""
        ...

    def take_tiles(self, images: object, other: object, tiles: np.ndarray) -> None:
        """Some tiles (rows, columns) bool of another picture of the same view into this one, and its counts.
        Pixels must not have samples in more than one tile."""
        ...


def can_hide(view: View, features: FeatureSet) -> bool:
    """Whether what is hidden can be told: of one pose, where nothing moves by itself, and where splats have
    bounds on the picture."""
    return not (view.shots or view.groups) and _extent(view, features) is not None


def least_keys(view: View, features: FeatureSet, boxes: Boxes) -> np.ndarray:
    """(n,) metres: below the sort keys of all splats in boxes."""
    extent = _extent(view, features)
    assert extent is not None  # `can_hide`
    if "compose_ordered" in features.names:
        return Turned(view, *boxes(0.0)).nearest(view)
    return extent.nearest(view, Turned(view, *boxes(extent.depths)))


def hidden(view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, ends: TileEnds) -> np.ndarray:
    """(n,) bool: the boxes none of whose splats can show in a picture with these ends.

    Args:
        boxes, reach: as `seen` takes them.
    """
    least, spans = least_keys(view, features, boxes), _spans(view, features, boxes, reach, ends)
    return least > _Largest(ends.depths).within(*spans)


def shown(view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, ends: TileEnds) -> np.ndarray:
    """(rows, columns) bool: the tiles of a picture with these ends in which splats of the boxes may show.

    Args:
        boxes, reach: as `seen` takes them.
    """
    made = np.zeros(ends.depths.shape, bool)
    least, spans = least_keys(view, features, boxes), _spans(view, features, boxes, reach, ends)
    for depth, top, bottom, left, right in zip(least, *spans, strict=True):
        made[top:bottom, left:right] |= ends.depths[top:bottom, left:right] >= depth
    return made


def _spans(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray, ends: TileEnds
) -> tuple[np.ndarray, ...]:
    """The rows [top, bottom) and columns [left, right) of tiles that boxes can touch, (n,) int64 each."""
    columns = ends.depths.shape[1]
    first, end = (0, view.height) if view.band is None else view.band
    band = first // ends.tile[0], -(-end // ends.tile[0])
    if view.raster is not None:
        return tuple(np.full(len(reach), side, np.int64) for side in (*band, 0, columns))
    low, high = _on_picture(view, features, boxes, reach)
    with np.errstate(invalid="ignore"):
        left = np.clip(np.floor((low[:, 0] - 1) / ends.tile[1]), 0, columns)
        right = np.clip(np.floor(high[:, 0] / ends.tile[1]) + 1, 0, columns)
        top = np.clip(np.floor((low[:, 1] - 1) / ends.tile[0]), *band)
        bottom = np.clip(np.floor(high[:, 1] / ends.tile[0]) + 1, *band)
    return tuple(each.astype(np.int64) for each in (top, bottom, left, right))


def _extent(view: View, features: FeatureSet) -> Extent | None:
    """How far splats show, or have depths of their own."""
    return Extent.of(view, features, _RANGE * ROOM)


def _on_picture(
    view: View, features: FeatureSet, boxes: Boxes, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) samples each: the least and the largest x, y that splats of boxes reach on the picture of a
    pinhole or of parallel rays; infinite where a box reaches to the camera."""
    extent = _extent(view, features)
    assert extent is not None  # `can_hide`
    radius, margin = extent.radius, extent.margin
    low, high = _projected(view, *boxes(radius))
    wide = ewa_reach(view, features, radius, reach[:, None])
    if wide is not None:
        least, most = _projected(view, *boxes(0.0))
        if not view.parallel:
            with np.errstate(divide="ignore", invalid="ignore"):
                nearest = Turned(view, *boxes(0.0)).nearest(view)[:, None]
                wide = np.where(nearest > 0, wide / nearest, np.inf)
        low, high = np.minimum(low, least - wide), np.maximum(high, most + wide)
    return low - margin, high + margin


def _projected(view: View, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 2) samples each: what boxes are on the picture, from their corners."""
    room = Turned(view, low, high).room[:, None] * math.sqrt(3.0)
    low, high = low - room, high + room
    least = np.full((len(low), 2), np.inf)
    most, nearest = -least, np.full(len(low), np.inf)
    focal, center = np.array([view.focal_x, view.focal_y]), np.array([view.center_x, view.center_y])
    for corner in range(8):
        which = np.array([corner & 1, corner >> 1 & 1, corner >> 2], bool)
        at = np.where(which, high, low) @ view.rotation.T + view.translation
        nearest = np.minimum(nearest, at[:, 2])
        with np.errstate(divide="ignore", invalid="ignore"):
            on = focal * (at[:, :2] if view.parallel else at[:, :2] / at[:, 2:]) + center
        least, most = np.minimum(least, on), np.maximum(most, on)
    if not view.parallel:
        least[~(nearest > 0)], most[~(nearest > 0)] = -np.inf, np.inf
    return least, most


class _Largest:
    """The largest value in rectangles of a grid."""

    def __init__(self, values: np.ndarray) -> None:
        self._tables: dict[tuple[int, int], np.ndarray] = {(0, 0): values}
        """by powers of two of rows and columns: the largest in as many from each place on"""

    def _table(self, down: int, across: int) -> np.ndarray:
        if (down, across) not in self._tables:
            if across:
                table, step = self._table(down, across - 1), 1 << (across - 1)
                made = np.maximum(table[:, :-step], table[:, step:])
            else:
                table, step = self._table(down - 1, 0), 1 << (down - 1)
                made = np.maximum(table[:-step], table[step:])
            self._tables[down, across] = made
        return self._tables[down, across]

    def within(self, top: np.ndarray, bottom: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """(n,) the largest in rows [top, bottom) and columns [left, right); -inf where there is none."""
        made = np.full(len(top), -np.inf)
        some = np.flatnonzero((bottom > top) & (right > left))
        tall, wide = (np.frexp(size[some])[1] - 1 for size in (bottom - top, right - left))
        for down, across in {*zip(tall.tolist(), wide.tolist(), strict=True)}:
            at = some[(tall == down) & (wide == across)]
            table, low, far = self._table(down, across), bottom[at] - (1 << down), right[at] - (1 << across)
            first = np.maximum(table[top[at], left[at]], table[top[at], far])
            made[at] = np.maximum(first, np.maximum(table[low, left[at]], table[low, far]))
        return made
