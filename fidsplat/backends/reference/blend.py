"""Blending: compositing of fragments and coplanar layers, with the same thresholds as on devices."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.reference import error_bounds
from fidsplat.backends.reference.external_depth import surface_at
from fidsplat.backends.reference.fragment_order import by_center, by_depth, by_layers
from fidsplat.backends.reference.fragments import fragments_of, shifted
from fidsplat.backends.reference.optics import ray_lengths
from fidsplat.backends.reference.post import background_at
from fidsplat.backends.reference.projection import ProjectedSplats
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet

INVERSE_DEPTH = 0.2 * 100 / (100 - 0.2)
"""metres: factor on inverse depths in the depth distortion"""
SPREAD_NEAR = 0.2
"""metres: minimum depth for the depth distortion"""
MIN_ALPHA = 1 / 255
"""minimum alpha of a sample with a label, depth or normal, at any cut-off"""
_ROUND = 2.0**-24  # relative rounding error of a transmittance per composited fragment
_EXACT_DEPTH = 5e-5
"""maximum relative error of a depth that is compared with a device: half of the tolerance"""


def composite(
    s: ProjectedSplats, view: View, features: FeatureSet, x: np.ndarray, y: np.ndarray
) -> dict[str, np.ndarray]:
    """Blend all splats at samples (k,) with grid positions x, y; returns the sample buffers."""
    f = fragments_of(s, view, x, y)
    span = error_bounds.span_of(s, view, f)
    surface = None if view.external_depth is None else surface_at(view.external_depth, view, x, y)
    if surface is not None:
        span = surface.occlude(f, span)
    sort = by_depth if s.by_depth else by_layers if s.coplanar_groups is not None else by_center
    ordered = sort(s, f, span)
    before, live, final = transmittance(ordered.alpha, view.transmittance_stop, s.exclusive)
    if surface is not None:
        ordered = surface.append_to(ordered)
        before = np.column_stack([before, final])
        live = np.column_stack([live, surface.exists])
        final = np.where(surface.exists, 0.0, final)
    alpha, z, span = ordered.alpha, ordered.z, ordered.span
    weight = np.where(live, before * alpha, 0.0)
    out = {
        "rgb": _sum(weight, ordered.colors),
        "t": final,
        "error_bound": error_bounds.of_color(s, view, span, before, ordered.moved) + ordered.reordered,
    }
    out["covered"] = 1 - final >= MIN_ALPHA
    out["covered_may_flip"] = np.abs(1 - final - MIN_ALPHA) <= out["error_bound"] + error_bounds.STOP
    if "fog" in features.post_steps:
        reach = -view.fog_density * ray_lengths(x, y, view)[:, None]
        left = np.exp(reach * z)
        out["rgb"] = _sum(weight * left, ordered.colors)
        out["fogged"] = (weight * (1 - left)).sum(1)
        with np.errstate(invalid="ignore"):
            moved = np.abs(np.exp(reach * np.maximum(span.z_low, 0)) - np.exp(reach * span.z_high))
        out["error_bound"] += (weight * moved).sum(1)
    if view.environment_map is not None:
        behind, moved = background_at(view, x, y)
        out["rgb"] = out["rgb"] + final[:, None] * behind
        out["behind_bound"] = final * moved
    contributes = live & (alpha > 0)
    if "distortion" in features.names:
        inverse = inverse_depth(z)
        sums = [(weight * np.where(z > 0, inverse**k, 0.0)).sum(1) for k in range(3)]
        out["distortion"] = sums[0] * sums[2] - sums[1] ** 2
    if {"depth", "depth_median", "depth_first"} & features.names:
        out["weight"] = weight.sum(1)
        out["depth"] = (weight * z).sum(1)
        out |= error_bounds.of_depth(span, weight, z)
        last, found, may_flip = median_of(before, alpha, contributes, span)
        out["depth_median"] = _pick(z, last, found, 0.0)
        out["depth_median_may_flip"] = may_flip | (
            _pick(span.z_high - span.z_low, last, found, 0.0) > _EXACT_DEPTH * out["depth_median"]
        )
        first = contributes & (before * (1 - alpha) <= view.first_hit_transmittance)
        out["depth_first"] = _pick(z, _first(first), np.asarray(first.any(1)), 0.0)
        out["depth_first_may_flip"] = error_bounds.of_first(span, view.first_hit_transmittance)
        out["depth_first_may_flip"] |= (
            _pick(span.z_high - span.z_low, _first(first), np.asarray(first.any(1)), 0.0)
            > _EXACT_DEPTH * out["depth_first"]
        )
    if "normal" in features.names:
        out["normal"] = _sum(weight, ordered.normal)
        out["normal_moved"] = (f.alpha * s.normal_error).sum(1)
    ids = {"label": ordered.labels, "splat_id": ordered.ids}
    flips = {"label": ordered.label_may_flip, "splat_id": ordered.id_may_flip}
    for name in sorted(ids.keys() & features.names):
        heaviest = _first(weight)
        out["heaviest"] = _pick(weight, heaviest, out["covered"], 0.0)
        out[name] = _pick(ids[name], heaviest, out["covered"], -1)
        flip = error_bounds.of_label(span, ids[name], out[name]) | flips[name].any(1)
        out[f"{name}_may_flip"] = (flip & out["covered"]) | out["covered_may_flip"]
    if "splat_id" in features.names and len(s.order):
        out["splat_id"] = np.where(out["splat_id"] >= 0, s.order[out["splat_id"].astype(int)], -1)
    if "blended" in features.names:
        out["blended"] = np.where(contributes, ordered.count, 0).sum(1)
        out["blended_bound"] = error_bounds.of_count(
            span, ordered.count, ordered.count_bound, view.transmittance_stop
        )
    return out


def inverse_depth(z: np.ndarray) -> np.ndarray:
    """Inverse depth in the units of the depth distortion: a depth buffer from 0.2 to 100 m, as in 2DGS."""
    return INVERSE_DEPTH / np.maximum(z, SPREAD_NEAR)


def _sum(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum (k, 3) of weights (k, m) times values (m, 3) or (k, m, 3)."""
    return (weight[:, None, :] @ values)[:, 0]


def transmittance(
    alpha: np.ndarray, stop: float, exclusive: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance in front of each fragment, whether it contributes, and the final transmittance."""
    after = np.cumprod(1 - alpha, axis=1)
    before = shifted(after)
    live = before > stop
    if exclusive:
        live &= ~np.logical_or.accumulate((alpha > 0) & (after <= stop), axis=1)
    return before, live, np.where(live, 1 - alpha, 1.0).prod(axis=1)


def _first(values: np.ndarray) -> np.ndarray:
    """Index (k,) of the first maximum in each row (k, n)."""
    return np.argmax(values, axis=1) if values.shape[1] else np.zeros(len(values), int)


def _pick(values: np.ndarray, index: np.ndarray, found: np.ndarray, otherwise: float) -> np.ndarray:
    if values.shape[1] == 0:
        return np.full(len(values), otherwise)
    return np.where(found, np.take_along_axis(values, index[:, None], 1)[:, 0], otherwise)


def median_of(
    before: np.ndarray, alpha: np.ndarray, contributes: np.ndarray, span: error_bounds.Span
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the fragment or layer of the median depth: the last with a transmittance above 0.5 in front of it.
    A run of fragments that together absorb less than `MIN_ALPHA` is represented by its last fragment.

    before, alpha: (k, m) transmittance in front of m fragments or layers, and their opacity. contributes: (k,
    m) bool. Returns (k,) index; whether there is a median; whether rounding to float32 may select another
    fragment.
    """
    k = len(before)
    last, left = np.full(k, -1), np.ones(k)  # left: transmittance behind the last represented fragment
    may_flip, slack = np.zeros(k, bool), np.zeros(k)
    may = (span.high > 0) & (span.front_high > 0.5 * (1 - error_bounds.STOP))
    must = (span.low > 0) & (span.front_low > 0.5 * (1 + error_bounds.STOP))
    counted = contributes & (before > 0.5)
    for column in np.flatnonzero(may.any(0)).tolist():
        at = np.s_[:, column]
        behind = before[at] * (1 - alpha[at])
        lowest, highest = span.front_low[at] * (1 - span.high[at]), span.front_high[at] * (1 - span.low[at])
        # rounding error of the difference of two transmittances
        slack = np.where(may[at], np.maximum(slack, 2 * (highest - lowest)) + 2 * _ROUND, slack)
        taken = left - behind - MIN_ALPHA
        may_flip |= may[at] & (taken >= -slack) & ~(must[at] & (taken > slack))
        counts = counted[at] & (taken >= 0)
        last, left = np.where(counts, column, last), np.where(counts, behind, left)
    return np.maximum(last, 0), last >= 0, may_flip
