"""Error bounds of the reference's outputs for rendering in float32.

A device evaluates the affine forms n_u, n_v, D of a pixel in float32, relative to the pixel nearest to the
splat's centre. Interval arithmetic over their rounding yields an interval of each fragment's opacity. It is
wide near a threshold (cut-off, near plane, horizon) and for splats that are thinner than the rounding error
of their distance. The error bound of a pixel is the sum of the possible changes of its fragments, to first
order.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from fidsplat.backends.reference.fragments import HALF_RHO_OF_RANGE, Fragments, cover, shifted
from fidsplat.backends.reference.optics import ROUND
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View

_ROUND = ROUND
_WEIGHT = 2 * _ROUND  # relative error of rho / 2 and of an opacity: a division, two products, exp
_DEPTH = _ROUND  # relative error of a depth in addition to its denominator's: numerator, division, product
STOP = 5e-5
"""relative error of a transmittance that is compared with a threshold"""


@dataclass
class Span:
    """Intervals of the values that fragments or layers (k, n) may have in float32."""

    low: np.ndarray
    """opacity"""
    high: np.ndarray
    z_low: np.ndarray
    """metres"""
    z_high: np.ndarray
    front_low: np.ndarray
    """transmittance in front of the fragment"""
    front_high: np.ndarray

    @classmethod
    def of(cls, low: np.ndarray, high: np.ndarray, z_low: np.ndarray, z_high: np.ndarray) -> Span:
        """Intervals of opacities and depths in compositing order, with the resulting transmittances."""
        fronts = shifted(np.cumprod(1 - high, axis=1)), shifted(np.cumprod(1 - low, axis=1))
        return cls(low, high, z_low, z_high, *fronts)


def span_of(s: ProjectedSplats, view: View, f: Fragments) -> Span:
    """Intervals of fragments that are computed in float32."""
    terms = [s.forms[:, :, c] for c in range(3)]
    e_u, e_v, e_d = (
        _rounding(s, f, form, term) for form, term in zip((f.n_u, f.n_v, f.d), terms, strict=True)
    )
    # the numerator of a depth has one rounding; with parallel rays it is a form with its own rounding
    e_dz = _ROUND * f.dz if s.depth_forms is None else _rounding(s, f, f.dz, s.depth_forms)
    d_low, d_high = f.d - e_d, f.d + e_d
    q_low = np.maximum(np.abs(f.n_u) - e_u, 0) ** 2 + np.maximum(np.abs(f.n_v) - e_v, 0) ** 2
    q_high = (np.abs(f.n_u) + e_u) ** 2 + (np.abs(f.n_v) + e_v) ** 2
    slack = _ROUND * (np.abs(s.log_opacity) + s.half_r2)  # the squared radius is a difference of float32
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        nearest, furthest = q_low / (2 * d_high**2), q_high / (2 * d_low**2)
        weight = _WEIGHT
        if s.inverse_m2.any():
            thick, ahead = s.inverse_m2 > 0, d_low > 0
            nearest = np.where(thick, 1 / (1 / nearest + 2 * s.inverse_m2), nearest)
            furthest = np.where(thick, 1 / (1 / furthest + 2 * s.inverse_m2), furthest)
            lowest, highest = s.inverse_m2 * q_low / d_high, s.inverse_m2 * q_high / d_low
            d_high = np.where(thick & (d_high > 0), d_high + np.where(ahead, highest, np.inf), d_high)
            d_low = np.where(thick & ahead, d_low + lowest, d_low)
            q_low = np.where(thick, 2 * nearest * np.maximum(d_low, 0) ** 2, q_low)
            q_high = np.where(thick, 2 * furthest * d_high**2, q_high)
            weight = np.where(thick, 2 * _WEIGHT, _WEIGHT)  # 3D Gaussians have twice the roundings
        may = (d_high > 0) & (d_low * view.near <= f.dz + e_dz)
        must = (d_low > 0) & (d_high * view.near <= f.dz - e_dz)
        plane = nearest, furthest
        nearest = np.where(may & (nearest <= s.half_r2 + slack), nearest, np.inf)
        furthest = np.where(must & (furthest <= s.half_r2 - slack), furthest, np.inf)
        near_dz, far_dz = (f.dz, f.dz) if s.depth_forms is None else (f.dz - e_dz, f.dz + e_dz)
        z_low = np.where(d_high > 0, near_dz / np.where(near_dz < 0, d_low, d_high), np.inf)
        z_high = np.where(d_low > 0, far_dz / np.where(far_dz < 0, d_high, d_low), np.inf)
    if s.has_screen_lowpass:
        away, off = np.sqrt(f.offset), _ROUND * (1 + f.dx + f.dy)
        lowpass_low, lowpass_high = np.maximum(away - off, 0) ** 2, (away + off) ** 2
        nearest = np.minimum(nearest, np.where(lowpass_low <= s.half_r2 + slack, lowpass_low, np.inf))
        furthest = np.minimum(furthest, np.where(lowpass_high <= s.half_r2 - slack, lowpass_high, np.inf))
    low = np.exp(s.log_opacity - furthest * (1 + weight)) * (1 - weight)
    high = np.exp(s.log_opacity - nearest * (1 - weight)) * (1 + weight)
    low, high = np.minimum(low, view.opacity_ceiling), np.minimum(high, view.opacity_ceiling)
    if s.box.any():
        # rounding errors of the distance to an edge: two forms, a product, a sum, and the gradient near the
        # edge
        off = np.stack(
            [
                (e_d + 1.5 * e) * edge + _ROUND * terms
                for e, edge, terms in zip((e_u, e_u, e_v, e_v), f.edges, f.edge_terms, strict=True)
            ]
        )
        whole = np.minimum(np.exp(s.log_opacity), view.opacity_ceiling)
        lowest = whole * cover(f.edges, f.n_u, f.n_v, f.d, -off - _ROUND) * (1 - _WEIGHT)
        highest = whole * cover(f.edges, f.n_u, f.n_v, f.d, off + _ROUND) * (1 + _WEIGHT)
        low = np.where(s.box, np.where(must, lowest, 0.0), low)
        high = np.where(s.box, np.where(may, highest, 0.0), high)
    z_low = np.where(d_low > 0, z_low, -np.inf)
    if s.has_screen_lowpass:
        # depths outside the circle are mirrored; where rounding decides, the interval has both (equal on the
        # circle)
        circle = np.maximum(lowpass_low, HALF_RHO_OF_RANGE), np.maximum(lowpass_high, HALF_RHO_OF_RANGE)
        beyond = _of_mirrored_depth(s, (d_low, d_high), (q_low, q_high), (near_dz, far_dz), circle)
        may_plane = s.coplanar | (plane[0] * (1 - weight) <= circle[1] * (1 + weight))
        may_beyond = ~s.coplanar & ((d_low <= 0) | (plane[1] * (1 + weight) >= circle[0] * (1 - weight)))
        z_low = np.minimum(np.where(may_plane, z_low, np.inf), np.where(may_beyond, beyond[0], np.inf))
        z_high = np.maximum(np.where(may_plane, z_high, -np.inf), np.where(may_beyond, beyond[1], -np.inf))
    z_low, z_high = np.clip(z_low, s.z_low, s.z_high), np.clip(z_high, s.z_low, s.z_high)
    # if a ray does not meet the plane beyond `near`, the fragment has the depth of the centre
    missed = ~must & s.has_lowpass
    z_low = np.where(missed, np.where(may, np.minimum(z_low, s.pz), s.pz), z_low)
    z_high = np.where(missed, np.where(may, np.maximum(z_high, s.pz), s.pz), z_high)
    # the ends of the depth range are a sum and a difference in float32; a disk that faces the camera exactly
    # has only one depth
    off = np.where(s.z_high > s.z_low, 2.0**-23 * (np.abs(s.z_low) + np.abs(s.z_high)), 0.0)
    z_low = np.where(z_low <= s.z_low, z_low - off, z_low)
    z_high = np.where(z_high >= s.z_high, z_high + off, z_high)
    return Span.of(low, high, z_low, z_high)


_Pair = tuple[np.ndarray, np.ndarray]
"""lowest and highest value, (k, n) or (n,)"""


def _of_mirrored_depth(s: ProjectedSplats, d: _Pair, q: _Pair, dz: _Pair, circle: _Pair) -> _Pair:
    """Depth bounds (k, n) of fragments outside the circle rho = C (docs/correctness.md, "The depth of a
    fragment"): pz + circle (dz - pz d) 2 d / q, from bounds of the factors. circle: C / 2."""
    d = np.maximum(d[0], 0.0), np.maximum(d[1], 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        beyond = dz[0] - np.maximum(s.pz * d[0], s.pz * d[1]), dz[1] - np.minimum(s.pz * d[0], s.pz * d[1])
        lowest, highest = 2 * circle[0] * d[0] / q[1], 2 * circle[1] * d[1] / q[0]
        low = s.pz + np.where(beyond[0] < 0, beyond[0] * highest, beyond[0] * lowest)
        high = s.pz + np.where(beyond[1] > 0, beyond[1] * highest, beyond[1] * lowest)
    off = 2 * _ROUND * np.abs(s.pz)  # error of the difference that is multiplied by a share
    return np.where(np.isnan(low), -np.inf, low - off), np.where(np.isnan(high), np.inf, high + off)


def _rounding(s: ProjectedSplats, f: Fragments, form: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Rounding error bounds (k, n) of affine forms (k, n) with factors (3, n)."""
    total = np.abs(form)
    for away, term in zip(f.away, terms, strict=True):
        total = total + away * np.abs(term)
    return s.round * total


def of_color(s: ProjectedSplats, view: View, span: Span, before: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Error bound (k,) of colour and alpha. moved (k, m): error bound of each fragment's own colour."""
    bound = (before * (span.high - span.low)).sum(1)
    t_low = span.front_low * (1 - span.high) * (1 - STOP)
    t_high = span.front_high * (1 - span.low) * (1 + STOP)
    may_stop = (span.high > 0) & (t_low <= view.transmittance_stop) & (t_high >= view.transmittance_stop)
    # an exclusive stop omits the fragment that reaches the threshold, an inclusive one only later fragments
    lost = span.front_high * span.high if s.exclusive else np.full_like(before, view.transmittance_stop)
    # if the order changes, the transmittance in front decides whether a fragment is blended
    may_miss = (
        (span.high > 0)
        & (span.front_low * (1 - STOP) <= view.transmittance_stop)
        & (span.front_high * (1 + STOP) >= view.transmittance_stop)
    )
    unsure = np.maximum(np.where(may_stop, lost, 0.0), np.where(may_miss, view.transmittance_stop, 0.0))
    bound += unsure.max(1, initial=0.0)
    return bound + (span.front_high * moved).sum(1)


def of_layer_color(min_tau: np.ndarray, max_tau: np.ndarray) -> np.ndarray:
    """Error bound (k, 1) of the colour of a layer of n splats, per unit of transmittance in front of it. The
    splats have optical depths (k, n) between `min_tau` and `max_tau`."""
    lowest = min_tau.sum(1, keepdims=True)
    others = max_tau.sum(1, keepdims=True) - max_tau
    # maximum derivative of the layer's colour with respect to one splat's optical depth
    slope = np.exp(-lowest) + np.minimum(1.0, others / np.maximum(lowest, 1e-9)) / np.maximum(lowest, 1.0)
    moved = np.minimum(1.0, slope * (max_tau - min_tau)).sum(1, keepdims=True)
    return np.where((max_tau > 0).sum(1, keepdims=True) > 1, moved, 0.0)


def of_box_color(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Error bound (k, 1) of the colour of a layer of n boxes with opacities between `low` and `high` (k, n):
    the sum over the boxes, or their mean if the opacities add up to more than 1."""
    return np.where((high > 0).sum(1, keepdims=True) > 1, (high - low).sum(1, keepdims=True), 0.0)


def of_layer_depth(
    z_low: np.ndarray, z_high: np.ndarray, share: np.ndarray, min_tau: np.ndarray, max_tau: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interval of the mean (k, 1) of the depths of n fragments (k, n), weighted by optical depth."""
    may = max_tau > 0
    count = may.sum(1, keepdims=True)
    none = count == 0
    nearest = np.where(may, z_low, np.inf).min(1, keepdims=True, initial=np.inf)
    furthest = np.where(may, z_high, -np.inf).max(1, keepdims=True, initial=-np.inf)
    nearest, furthest = np.where(none, 0.0, nearest), np.where(none, 0.0, furthest)
    lowest = min_tau.sum(1, keepdims=True)
    spread = furthest - nearest
    moved = spread * np.minimum(1.0, 2 * (max_tau - min_tau).sum(1, keepdims=True) / np.maximum(lowest, 1e-9))
    low = np.where(share > 0, share * z_low, 0.0).sum(1, keepdims=True) - moved
    high = np.where(share > 0, share * z_high, 0.0).sum(1, keepdims=True) + moved
    blended = share.any(1, keepdims=True)
    low = np.where(blended, np.maximum(low, nearest), nearest)
    high = np.where(blended, np.minimum(high, furthest), furthest)
    # the running mean is rounded at every fragment
    off = (2 + count) * 2.0**-24 * np.maximum(np.abs(nearest), np.abs(furthest))
    return low - off, high + off


def first_column(mask: np.ndarray, start: int) -> np.ndarray:
    """Index (k,), plus `start`, of the first column where mask (k, m) is set; start + m if none is set."""
    k, m = mask.shape
    return start + np.where(mask.any(1), np.argmax(mask, axis=1), m) if m else np.full(k, start)


def of_order(span: Span, depth_bias: np.ndarray) -> tuple[Span, np.ndarray]:
    """Bounds of transmittance and colour over all depth orders that rounding allows.

    span: of fragments or layers (k, m) sorted by depth. Returns it with wider intervals of the transmittance
    in front of each fragment, and (k,) the largest change of a pixel's colour, for colours in [0, 1].
    depth_bias (k, m): length subtracted from each depth before sorting.

    Swapping two neighbours changes a colour by at most the product of their opacities and the
    transmittance in front of them, and every possible order results from swaps of pairs with overlapping
    depth intervals. Exactly equal depths keep their order.
    """
    near, far = _sort_depths(span, depth_bias)
    may, exact = span.high > 0, span.z_low == span.z_high
    furthest = np.maximum.accumulate(far, axis=1)
    nearest = np.minimum.accumulate(near[:, ::-1], axis=1)[:, ::-1]
    pairs = []
    for apart in range(1, span.low.shape[1]):
        first, second = np.s_[:, :-apart], np.s_[:, apart:]
        if not (furthest[first] >= nearest[second]).any():
            break
        may_swap = may[first] & may[second] & (far[first] >= near[second])
        may_swap &= ~(exact[first] & exact[second] & (near[first] == near[second]))
        pairs.append((first, second, may_swap))
    return _of_swaps(span, pairs)


def of_layers(span: Span, depth_bias: np.ndarray, position: np.ndarray) -> tuple[Span, np.ndarray]:
    """Bounds as in `of_order`, for fragments in the order of the splats' centres and layers sorted by depth.

    Two fragments may also swap if rounding decides whether a layer is between them. position (k, m): index
    in the order of centres; negative for layers.
    """
    near, far = _sort_depths(span, depth_bias)
    may, layered = span.high > 0, position < 0
    bound, lowest, highest = np.zeros(len(may)), span.front_low.copy(), span.front_high.copy()
    layers = layered.sum(1).max(initial=0)
    # for each layer: whether it may exist, whether it surely exists, and its interval
    columns = np.argsort(~layered, axis=1, kind="stable")[:, :layers]
    own = [np.take_along_axis(each, columns, 1) for each in (may & layered, span.low > 0, near, far)]
    unsure = np.zeros(len(may), bool)
    for exists, surely, low, high in zip(*(each.T[:, :, None] for each in own), strict=True):
        meets = may & (far >= low) & (near <= high)
        unsure |= exists[:, 0] & (~surely[:, 0] | (meets.sum(1) > 1))  # a layer overlaps itself
    rows = np.flatnonzero(unsure)
    if len(rows) == 0:
        return span, bound
    near, far, may, layered, position = (each[rows] for each in (near, far, may, layered, position))
    own = [each[rows].T[:, :, None] for each in own]
    pairs = []
    for apart in range(1, near.shape[1]):
        first, second = np.s_[:, :-apart], np.s_[:, apart:]
        between, divided = np.zeros(near[first].shape, bool), np.zeros(near[first].shape, bool)
        for exists, surely, low, high in zip(*own, strict=True):
            between |= exists & (far[first] >= low) & (near[second] <= high)
            divided |= exists & surely & (far[first] < low) & (near[second] > high)
        swapped = np.where(position[first] < position[second], between, ~divided)
        may_swap = np.where(layered[first] | layered[second], far[first] >= near[second], swapped)
        pairs.append((first, second, may_swap & may[first] & may[second]))
    part = Span(*(getattr(span, field.name)[rows] for field in fields(Span)))
    part, bound[rows] = _of_swaps(part, pairs)
    lowest[rows], highest[rows] = part.front_low, part.front_high
    return replace(span, front_low=lowest, front_high=highest), bound


def _sort_depths(span: Span, depth_bias: np.ndarray) -> _Pair:
    """Nearest and furthest depths (k, m) at which rounding may sort fragments and layers."""
    may = span.high > 0
    near = np.where(may, span.z_low - depth_bias - _DEPTH * np.abs(span.z_low), np.inf)
    return near, np.where(may, span.z_high - depth_bias + _DEPTH * np.abs(span.z_high), -np.inf)


def _of_swaps(span: Span, pairs: list[tuple]) -> tuple[Span, np.ndarray]:
    """Bounds over all orders in which pairs may be swapped. pairs: two slices of columns, and a mask of
    samples."""
    log_passed = np.log1p(-np.minimum(span.low, 1 - 2.0**-53))
    log_transmittance = np.cumsum(log_passed, axis=1) - log_passed
    lowest = span.front_low.copy()
    for first, second, may_swap in pairs:
        log_transmittance[second] -= np.where(may_swap, log_passed[first], 0.0)
        lowest[first] *= np.where(may_swap, 1 - span.high[second], 1.0)
    highest = np.exp(log_transmittance) if pairs else span.front_high
    bound = np.zeros(len(log_transmittance))
    for first, second, may_swap in pairs:
        front = np.minimum(highest[first], highest[second])
        bound += np.where(may_swap, front * span.high[first] * span.high[second], 0.0).sum(1)
    return replace(span, front_low=lowest, front_high=highest), bound


def of_depth(span: Span, weight: np.ndarray, z: np.ndarray) -> dict[str, np.ndarray]:
    """Smallest and largest possible depth (k,), and the sum of weights times the error of each depth."""
    possible = span.front_high * span.high > 0
    return {
        "nearest": np.where(possible, span.z_low, np.inf).min(1, initial=np.inf),
        "furthest": np.where(possible, span.z_high, -np.inf).max(1, initial=-np.inf),
        "depth_moved": (weight * np.maximum(span.z_high - z, z - span.z_low)).sum(1),
    }


def of_first(span: Span, threshold: float) -> np.ndarray:
    """(k,) bool: whether rounding may change the first fragment behind which transmittance is below
    `threshold`."""
    high, low = span.high, span.low
    may = (high > 0) & (span.front_low * (1 - high) * (1 - STOP) <= threshold)
    sure = (low > 0) & (span.front_high * (1 - low) * (1 + STOP) <= threshold)
    return first_column(may, 0) != first_column(sure, 0)


def of_count(span: Span, count: np.ndarray, bound: np.ndarray, stop: float) -> np.ndarray:
    """Error bound (k,) of the number of blended splats. count, bound (k, m): of each fragment."""
    may, must = span.high > 0, span.low > 0
    off = np.where(may, bound + np.where(must, 0, count), 0)
    # rounding decides between the first fragment that may reach the stop and the first that must
    open_to = (span.front_high >= stop * (1 - STOP)) & (span.front_low * (1 - span.high) <= stop * (1 + STOP))
    return np.where(may & open_to & (stop > 0), count + bound, off).sum(1)


def of_label(span: Span, labels: np.ndarray, label: np.ndarray) -> np.ndarray:
    """(k,) bool: whether rounding may change the label of a sample."""
    own = labels == label[:, None]
    heaviest = np.where(own, span.front_low * span.low, 0.0).max(1, initial=0.0)
    other = np.where(own, 0.0, span.front_high * span.high).max(1, initial=0.0)
    return ((other > 0) | (label >= 0)) & (other * (1 + STOP) >= heaviest)
