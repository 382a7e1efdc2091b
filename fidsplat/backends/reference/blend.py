"""Compositing of fragments and layers, with every decision that devices take."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.reference import doubt
from fidsplat.backends.reference.fragments import fragments_of, shifted
from fidsplat.backends.reference.layers import in_layers, in_order
from fidsplat.backends.reference.setup import Setup
from fidsplat.effects import FeatureSet


def composite(
    s: Setup, view: View, features: FeatureSet, x: np.ndarray, y: np.ndarray
) -> dict[str, np.ndarray]:
    """Samples (k,) at grid positions x, y against all splats: what blending leaves, before resolving."""
    f = fragments_of(s, view, x, y)
    span = doubt.span_of(s, view, f)
    laid = in_order(s, f, span) if s.planes is None else in_layers(s, f, span, s.planes)
    alpha, z, span = laid.alpha, laid.z, laid.span
    before, live, final = _transmittance(alpha, view.stop, s.exclusive)
    weight = np.where(live, before * alpha, 0.0)
    out = {
        "rgb": _sum(weight, laid.colors),
        "t": final,
        "certificate": doubt.of_color(s, view, span, before, laid.moved) + laid.reordered,
    }
    drawn = live & (alpha > 0)
    if {"depth", "depth_median"} & set(features.taps):
        out["weight"] = weight.sum(1)
        out["depth"] = (weight * z).sum(1)
        out |= doubt.of_depth(span, weight, z)
        half = drawn & (before > 0.5)
        last, seen = half.shape[1] - 1 - _first(half[:, ::-1]), np.asarray(half.any(1))
        out["depth_median"] = _pick(z, last, seen, 0.0)
        out["depth_median_may_flip"] = (
            doubt.of_median(span)
            | (_pick(span.z_high - span.z_low, last, seen, 0.0) > 1e-5 * out["depth_median"])
            | (laid.reordered > 0)
        )
    if "normal" in features.taps:
        out["normal"] = _sum(weight, laid.normal)
    if "label" in features.taps:
        heaviest = _first(weight)
        out["label_weight"] = _pick(weight, heaviest, np.asarray(drawn.any(1)), 0.0)
        out["label"] = _pick(laid.labels, heaviest, out["label_weight"] > 0, -1)
        out["label_may_flip"] = (
            doubt.of_label(span, laid.labels, out["label"])
            | laid.label_may_flip.any(1)
            | (laid.reordered > 0)
        )
    return out


def _sum(weight: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum (k, 3) of weights (k, m) times values (m, 3) or (k, m, 3)."""
    return (weight[:, None, :] @ values)[:, 0]


def _transmittance(
    alpha: np.ndarray, stop: float, exclusive: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance before each thing, which are drawn, and what is left at the end."""
    after = np.cumprod(1 - alpha, axis=1)
    before = shifted(after)
    live = before > stop
    if exclusive:
        live &= ~np.logical_or.accumulate((alpha > 0) & (after <= stop), axis=1)
    return before, live, np.where(live, 1 - alpha, 1.0).prod(axis=1)


def _first(values: np.ndarray) -> np.ndarray:
    """Place (k,) of the first of the largest in each row (k, n)."""
    return np.argmax(values, axis=1) if values.shape[1] else np.zeros(len(values), int)


def _pick(values: np.ndarray, index: np.ndarray, found: np.ndarray, otherwise: float) -> np.ndarray:
    if values.shape[1] == 0:
        return np.full(len(values), otherwise)
    return np.where(found, np.take_along_axis(values, index[:, None], 1)[:, 0], otherwise)
