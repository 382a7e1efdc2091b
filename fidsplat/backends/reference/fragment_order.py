"""Depth order of a sample's fragments (docs/correctness.md): by splat centres, or by depth at each sample."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fidsplat.backends.reference import error_bounds
from fidsplat.backends.reference.error_bounds import Span
from fidsplat.backends.reference.fragments import Fragments, optical_depth
from fidsplat.backends.reference.projection import ProjectedSplats

COPLANAR_BIAS = 2.0**-16
"""fraction of its depth by which a coplanar layer is sorted nearer: more than rounding errors, but
invisible"""


@dataclass
class OrderedFragments:
    """Fragments and layers of k samples, m each, in compositing order."""

    alpha: np.ndarray
    """(k, m); also z [m], labels, moved, label_may_flip"""
    z: np.ndarray
    span: Span
    colors: np.ndarray
    """(m, 3) or (k, m, 3); also normal"""
    normal: np.ndarray
    labels: np.ndarray
    ids: np.ndarray
    """index in the depth order; for a layer, the index of the splat with the largest weight"""
    count: np.ndarray
    """number of splats blended in each fragment or layer"""
    count_bound: np.ndarray
    """error bound of this number, if the fragment contributes"""
    moved: np.ndarray
    """error bound of a layer's mean colour, per unit of transmittance in front of it"""
    label_may_flip: np.ndarray
    """bool: whether rounding may change the layer's label"""
    id_may_flip: np.ndarray
    reordered: np.ndarray
    """(k,) error bound of colour due to possible changes of the order"""

    def reordered_by(self, rank: np.ndarray) -> OrderedFragments:
        """Reorder by rank (k, m)."""

        def of(array: np.ndarray) -> np.ndarray:
            return np.take_along_axis(array, rank if array.ndim == 2 else rank[:, :, None], 1)

        s = self.span
        span = Span.of(of(s.low), of(s.high), of(s.z_low), of(s.z_high))
        return OrderedFragments(
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
"""fields of OrderedFragments with m values per sample"""


def by_center(s: ProjectedSplats, f: Fragments, span: Span) -> OrderedFragments:
    """Fragments in the order of the splats' centres."""
    # colours and normals are stored once, not for each sample
    return replace(_plain(s, f, span, slice(None)), colors=s.colors, normal=s.normal)


def by_depth(s: ProjectedSplats, f: Fragments, span: Span) -> OrderedFragments:
    """Fragments, and a layer for each coplanar group, sorted by their depths at each sample. Ties: layers
    first, then the splats' order. Fragments that do not contribute are left out."""
    columns, depth_bias, tie_order = _with_layers(s, f, span)
    may = columns.span.high > 0
    depth = np.where(may, columns.z - depth_bias, np.inf)
    rank = _rank(may, tie_order, depth)
    ordered, depth_bias = columns.reordered_by(rank), np.take_along_axis(depth_bias, rank, 1)
    ordered.span, ordered.reordered = error_bounds.of_order(ordered.span, depth_bias)
    return ordered


def by_layers(s: ProjectedSplats, f: Fragments, span: Span) -> OrderedFragments:
    """Fragments in the order of the splats' centres, and layers of coplanar groups by depth at each sample,
    behind nearer fragments and in front of the others. Fragments that do not contribute are left out."""
    columns, depth_bias, tie_order = _with_layers(s, f, span)
    may, layered = columns.span.high > 0, tie_order < 0
    depth, exists = columns.z - depth_bias, columns.alpha > 0
    # number of layers in front of each fragment, and of each layer by its rank among layers
    in_front = np.zeros(depth.shape, int)
    for layer in np.flatnonzero(layered):
        first = np.where(layered, tie_order > tie_order[layer], True)
        nearer = (depth[:, [layer]] < depth) | ((depth[:, [layer]] == depth) & first)
        in_front += 2 * (nearer & exists[:, [layer]])
    rank = _rank(may, tie_order, in_front + layered)
    ordered, depth_bias = columns.reordered_by(rank), np.take_along_axis(depth_bias, rank, 1)
    position = tie_order[rank]
    ordered.span, ordered.reordered = error_bounds.of_layers(ordered.span, depth_bias, position)
    return ordered


def _with_layers(
    s: ProjectedSplats, f: Fragments, span: Span
) -> tuple[OrderedFragments, np.ndarray, np.ndarray]:
    """Fragments (k, n) of splats without a group, then layers (k, p); the depth bias of each [m]; and a key
    (n + p,) that orders fragments of equal depth: the splat's index, or a negative number for a layer."""
    groups = np.full(f.alpha.shape[1], -1) if s.coplanar_groups is None else s.coplanar_groups
    plain = np.flatnonzero(groups < 0)
    members = [np.flatnonzero(groups == group) for group in np.unique(groups[groups >= 0])]
    columns = _concatenated([_plain(s, f, span, plain), *(_layer(s, f, span, splats) for splats in members)])
    tie_order = np.concatenate([plain, np.arange(len(members)) - len(members)])
    # a coplanar layer is composited in front of other splats in its plane
    return columns, np.where(tie_order < 0, COPLANAR_BIAS * np.abs(columns.z), 0.0), tie_order


def _rank(may: np.ndarray, tie_order: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Columns (k, m) of the fragments that may contribute, sorted by `key` (k, n), then `tie_order` (n,)."""
    rank = np.lexsort((np.broadcast_to(tie_order, key.shape), key, ~may), axis=1)
    return rank[:, : may.sum(1).max(initial=0)]


def _plain(s: ProjectedSplats, f: Fragments, span: Span, splats: np.ndarray | slice) -> OrderedFragments:
    """Fragments (k, m) of m splats, in the order of the splats."""
    ids = np.arange(f.alpha.shape[1])[splats]
    k, m = len(f.alpha), len(ids)
    nothing = np.zeros((k, m))
    return OrderedFragments(
        alpha=f.alpha[:, splats],
        z=f.z[:, splats],
        span=Span.of(
            span.low[:, splats], span.high[:, splats], span.z_low[:, splats], span.z_high[:, splats]
        ),
        colors=np.broadcast_to(s.colors[splats], (k, m, 3)),
        normal=np.broadcast_to(s.normal[splats], (k, m, 3)),
        labels=np.broadcast_to(s.labels[splats], (k, m)),
        ids=np.broadcast_to(ids, (k, m)),
        count=nothing + 1,
        count_bound=nothing,
        moved=nothing,
        label_may_flip=nothing > 0,
        id_may_flip=nothing > 0,
        reordered=np.zeros(k),
    )


def _layer(s: ProjectedSplats, f: Fragments, span: Span, splats: np.ndarray) -> OrderedFragments:
    """Layer (k, 1) of the splats (indices) of a coplanar group."""
    alpha, z, z_low, z_high = (each[:, splats] for each in (f.alpha, f.z, span.z_low, span.z_high))
    low, high = span.low[:, splats], span.high[:, splats]
    boxes = bool(s.box[splats[0]])  # all splats of a group have one footprint
    tau = alpha if boxes else optical_depth(alpha)
    total = tau.sum(1, keepdims=True)
    share = tau / np.where(total > 0, total, 1)
    # 1 - opacity is rounded too
    min_tau, max_tau = optical_depth(low - 2.0**-23), np.where(high > 0, optical_depth(high + 2.0**-23), 0.0)
    if boxes:
        min_tau, max_tau = low, high
    heaviest = np.argmax(tau, axis=1)[:, None]
    labels = s.labels[splats]
    label = labels[heaviest]
    as_heavy = (high > 0) & (max_tau >= np.take_along_axis(min_tau, heaviest, 1))
    contributes = alpha > 0
    z_low, z_high = error_bounds.of_layer_depth(z_low, z_high, share, min_tau, max_tau)
    depth = np.where(total > 0, (share * z).sum(1, keepdims=True), (z_low + z_high) / 2)
    covered = (_coverage(each, boxes) for each in (alpha, low, high))
    opacity, low, high = covered
    return OrderedFragments(
        alpha=opacity,
        z=depth,
        span=Span.of(low, high, z_low, z_high),
        colors=(share @ s.colors[splats])[:, None],
        normal=(share @ s.normal[splats])[:, None],
        labels=label,
        ids=splats[heaviest],
        count=contributes.sum(1, keepdims=True),
        count_bound=((low > 0) != (high > 0)).sum(1, keepdims=True),
        moved=error_bounds.of_box_color(low, high)
        if boxes
        else error_bounds.of_layer_color(min_tau, max_tau),
        label_may_flip=(as_heavy & (labels != label)).any(1, keepdims=True),
        id_may_flip=as_heavy.sum(1, keepdims=True) > 1,
        reordered=np.zeros(len(alpha)),
    )


def _coverage(opacity: np.ndarray, boxes: bool) -> np.ndarray:
    """Opacity (k, 1) of a layer: the sum for boxes, which do not overlap; else 1 - prod(1 - opacity)."""
    if boxes:
        return np.minimum(opacity.sum(1, keepdims=True), 1.0)
    return 1 - (1 - opacity).prod(1, keepdims=True)


def _concatenated(parts: list[OrderedFragments]) -> OrderedFragments:
    def joined(name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in parts], axis=1)

    spans = (
        np.concatenate([getattr(part.span, name) for part in parts], axis=1)
        for name in ("low", "high", "z_low", "z_high")
    )
    return OrderedFragments(
        span=Span.of(*spans), reordered=parts[0].reordered, **{name: joined(name) for name in _COLUMNS}
    )
