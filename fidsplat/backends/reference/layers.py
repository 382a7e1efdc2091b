"""The splats of a plane as one layer per sample, placed by its own depth (docs/coplanar.md).

Columns are what arrives in the depth order: splats of no plane one by one, the splats of a plane together,
where their common key puts them. A layer is pending from there until a fragment of no plane arrives that lies
behind it, or until a third layer begins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fidsplat.backends.reference import error_bounds
from fidsplat.backends.reference.error_bounds import Span
from fidsplat.backends.reference.fragments import Fragments, optical_depth
from fidsplat.backends.reference.setup import Setup


@dataclass
class Stack:
    """What k samples see, m things each in the order in which they are composited: fragments, or layers as
    one."""

    alpha: np.ndarray
    """(k, m), as z [m], labels, moved, label_may_flip"""
    z: np.ndarray
    span: Span
    colors: np.ndarray
    """(m, 3) or (k, m, 3), as normal"""
    normal: np.ndarray
    labels: np.ndarray
    ids: np.ndarray
    """places in the depth order of the splats that stand for the layers"""
    count: np.ndarray
    """splats that are blended in each"""
    count_bound: np.ndarray
    """how many more or less they may be, if it is drawn at all"""
    moved: np.ndarray
    """what may change in a layer's mean colour, per unit of light in front of it"""
    label_may_flip: np.ndarray
    """bool: whether another label may be the layer's"""
    id_may_flip: np.ndarray
    reordered: np.ndarray
    """(k,) what may change in colour because things may be composited in another order"""

    def take(self, rank: np.ndarray) -> Stack:
        """The same in another order: rank (k, m)."""

        def of(array: np.ndarray) -> np.ndarray:
            return np.take_along_axis(array, rank if array.ndim == 2 else rank[:, :, None], 1)

        s = self.span
        span = Span.of(of(s.low), of(s.high), of(s.z_low), of(s.z_high))
        return Stack(
            span=span, reordered=self.reordered, **{name: of(getattr(self, name)) for name in _COLUMNS}
        )


_COLUMNS = (
    "alpha",
    "z",
    "colors",
    "normal",
    "labels",
    "ids",
    "count",
    "count_bound",
    "moved",
    "label_may_flip",
    "id_may_flip",
)
"""fields of Stack that have a value for each of the m things"""


def in_order(s: Setup, f: Fragments, span: Span) -> Stack:
    """Every fragment by itself, in the depth order of the splats."""
    shape = f.alpha.shape
    nothing = np.zeros(shape)
    return Stack(
        alpha=f.alpha,
        z=f.z,
        span=span,
        colors=s.colors,
        normal=s.normal,
        labels=np.broadcast_to(s.labels, shape),
        ids=np.broadcast_to(np.arange(shape[1]), shape),
        count=nothing + 1,
        count_bound=nothing,
        moved=nothing,
        label_may_flip=nothing > 0,
        id_may_flip=nothing > 0,
        reordered=np.zeros(len(f.alpha)),
    )


def in_layers(s: Setup, f: Fragments, span: Span, planes: np.ndarray) -> Stack:
    """The fragments of each plane as one layer, each where the rule lays it. planes (n,): -1 for none."""
    plain = np.flatnonzero(planes < 0)
    members = [np.flatnonzero(planes == plane) for plane in np.unique(planes[planes >= 0])]
    members.sort(key=lambda splats: splats[0])
    layers = [_layer(s, f, span, splats) for splats in members]
    arrival = np.argsort(np.concatenate([plain, [splats[0] for splats in members]]), kind="stable")
    rest = _plain(s, f, span, plain)
    columns = _side_by_side([rest, *layers]).take(np.broadcast_to(arrival, (len(f.alpha), len(arrival))))
    is_layer = arrival >= len(plain)
    place = _places(columns, is_layer)
    columns.reordered = error_bounds.of_places(columns.span, is_layer)
    # before the fragment at a place, its layers, the nearest first
    count = len(arrival)
    nearness = np.where(is_layer, columns.z, 0.0)
    behind = np.broadcast_to(~is_layer, (len(place), count))
    return columns.take(np.lexsort((nearness, behind, place), axis=1))


def _plain(s: Setup, f: Fragments, span: Span, splats: np.ndarray) -> Stack:
    k, m = len(f.alpha), len(splats)
    nothing = np.zeros((k, m))
    return Stack(
        alpha=f.alpha[:, splats],
        z=f.z[:, splats],
        span=Span.of(
            span.low[:, splats], span.high[:, splats], span.z_low[:, splats], span.z_high[:, splats]
        ),
        colors=np.broadcast_to(s.colors[splats], (k, m, 3)),
        normal=np.broadcast_to(s.normal[splats], (k, m, 3)),
        labels=np.broadcast_to(s.labels[splats], (k, m)),
        ids=np.broadcast_to(splats, (k, m)),
        count=nothing + 1,
        count_bound=nothing,
        moved=nothing,
        label_may_flip=nothing > 0,
        id_may_flip=nothing > 0,
        reordered=np.zeros(k),
    )


def _layer(s: Setup, f: Fragments, span: Span, splats: np.ndarray) -> Stack:
    """The layer (k, 1) of the splats (indices) of a plane."""
    alpha, z = f.alpha[:, splats], f.z[:, splats]
    low, high = span.low[:, splats], span.high[:, splats]
    boxes = bool(s.box[splats[0]])  # a plane has one footprint
    tau = alpha if boxes else optical_depth(alpha)
    total = tau.sum(1, keepdims=True)
    share = tau / np.where(total > 0, total, 1)
    # 1 - opacity is rounded too
    thin, thick = optical_depth(low - 2.0**-23), np.where(high > 0, optical_depth(high + 2.0**-23), 0.0)
    if boxes:
        thin, thick = low, high
    heaviest = np.argmax(tau, axis=1)[:, None]
    labels = s.labels[splats]
    label = labels[heaviest]
    as_heavy = (high > 0) & (thick >= np.take_along_axis(thin, heaviest, 1))
    drawn = alpha > 0
    z_low, z_high = error_bounds.of_layer_depth(
        span.z_low[:, splats], span.z_high[:, splats], share, thin, thick
    )
    depth = np.where(total > 0, (share * z).sum(1, keepdims=True), (z_low + z_high) / 2)
    covered = (_covered(each, boxes) for each in (alpha, low, high))
    opacity, least, most = covered
    return Stack(
        alpha=opacity,
        z=depth,
        span=Span.of(least, most, z_low, z_high),
        colors=(share @ s.colors[splats])[:, None],
        normal=(share @ s.normal[splats])[:, None],
        labels=label,
        ids=splats[heaviest],
        count=drawn.sum(1, keepdims=True),
        count_bound=((low > 0) != (high > 0)).sum(1, keepdims=True),
        moved=error_bounds.of_box_color(low, high) if boxes else error_bounds.of_layer_color(thin, thick),
        label_may_flip=(as_heavy & (labels != label)).any(1, keepdims=True),
        id_may_flip=as_heavy.sum(1, keepdims=True) > 1,
        reordered=np.zeros(len(alpha)),
    )


def _covered(opacity: np.ndarray, boxes: bool) -> np.ndarray:
    """Opacity (k, 1) of a layer: boxes lie side by side, Gaussians over one another."""
    if boxes:
        return np.minimum(opacity.sum(1, keepdims=True), 1.0)
    return 1 - (1 - opacity).prod(1, keepdims=True)


def _side_by_side(parts: list[Stack]) -> Stack:
    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts], axis=1)

    spans = (
        np.concatenate([getattr(part.span, name) for part in parts], axis=1)
        for name in ("low", "high", "z_low", "z_high")
    )
    return Stack(
        span=Span.of(*spans), reordered=parts[0].reordered, **{name: joined(name) for name in _COLUMNS}
    )


def _places(columns: Stack, is_layer: np.ndarray) -> np.ndarray:
    """Before which column (k, m) each is composited; a fragment at its own, m for what comes at the end."""
    k, m = columns.alpha.shape
    place = np.tile(np.arange(m), (k, 1))
    drawn = columns.alpha > 0
    rows = np.arange(k)
    # columns of the two pending layers, the one that arrived first in front; -1: none
    waiting, opened = np.full(k, -1), np.full(k, -1)
    for column in np.flatnonzero(is_layer).tolist():
        behind = columns.z[:, column + 1 :] > columns.z[:, column, None]
        place[:, column] = error_bounds.first_column(
            behind & drawn[:, column + 1 :] & ~is_layer[column + 1 :], column + 1
        )
        begins = drawn[:, column]
        waiting = np.where(place[rows, waiting] < column, -1, waiting)
        opened = np.where(place[rows, opened] < column, -1, opened)
        both = begins & (waiting >= 0) & (opened >= 0)
        newer = both & (columns.z[rows, opened] < columns.z[rows, waiting])
        nearer = np.where(newer, opened, waiting)
        place[rows[both], nearer[both]] = column
        waiting = np.where(begins & (opened >= 0) & ~newer, opened, waiting)
        opened = np.where(begins, column, opened)
    return place
