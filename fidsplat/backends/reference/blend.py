"""Compositing of fragments, with every decision that devices take."""

from __future__ import annotations

import numpy as np

from fidsplat.backends.base import View
from fidsplat.backends.reference import doubt
from fidsplat.backends.reference.fragments import fragments_of, optical_depth, runs, shifted
from fidsplat.backends.reference.setup import Setup
from fidsplat.effects import FeatureSet


def composite(
    s: Setup, view: View, features: FeatureSet, x: np.ndarray, y: np.ndarray
) -> dict[str, np.ndarray]:
    """Samples (k,) at grid positions x, y against all splats: what blending leaves, before resolving."""
    f = fragments_of(s, view, x, y)
    alpha = f.alpha
    run = None if s.planes is None else runs(alpha > 0, s.planes)
    before, live, final = _transmittance(alpha, view.stop, s.exclusive, run)
    weight = np.where(live, before * alpha, 0.0)
    span = doubt.span_of(s, view, f)
    out = {
        "rgb": weight @ s.colors if run is None else _layered(alpha, weight, live, run, s.colors),
        "t": final,
        "certificate": doubt.of_color(s, view, span, before, weight),
    }
    drawn = live & (alpha > 0)
    if {"depth", "depth_median"} & set(features.taps):
        out["weight"] = weight.sum(1)
        out["depth"] = (weight * f.z).sum(1)
        out |= doubt.of_depth(span, weight, f.z)
        half = drawn & (before > 0.5)
        last, seen = half.shape[1] - 1 - _first(half[:, ::-1]), np.asarray(half.any(1))
        out["depth_median"] = _pick(f.z, last, seen, 0.0)
        out["depth_median_may_flip"] = doubt.of_median(span) | (
            _pick(span.z_high - span.z_low, last, seen, 0.0) > 1e-5 * out["depth_median"]
        )
    if "normal" in features.taps:
        out["normal"] = weight @ s.normal
    if "label" in features.taps:
        heaviest = _first(weight)
        out["label_weight"] = _pick(weight, heaviest, np.asarray(drawn.any(1)), 0.0)
        labels = np.broadcast_to(s.labels, weight.shape)
        out["label"] = _pick(labels, heaviest, out["label_weight"] > 0, -1)
        out["label_may_flip"] = doubt.of_label(span, labels, out["label"])
    return out


def _layered(
    alpha: np.ndarray, weight: np.ndarray, live: np.ndarray, run: np.ndarray, colors: np.ndarray
) -> np.ndarray:
    """Colours (k, 3) where a run is one layer: its weight, in the mean colour by optical depth."""
    row, column = np.nonzero(live & (run >= 0))
    number = run[row, column]
    tau = optical_depth(alpha[row, column])
    count = int(run.max(initial=-1)) + 1
    ink = np.zeros((count, 3))
    np.add.at(ink, number, tau[:, None] * colors[column])
    depth = np.bincount(number, tau, count)
    total = np.bincount(number, weight[row, column], count)
    mean = ink / np.where(depth > 0, depth, 1)[:, None]
    owner = np.zeros(count, int)
    owner[number] = row
    rgb = np.zeros((len(alpha), 3))
    np.add.at(rgb, owner, total[:, None] * mean)
    return rgb


def _transmittance(
    alpha: np.ndarray, stop: float, exclusive: bool, run: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transmittance before each fragment, which fragments are drawn, and what is left at the end.

    With runs (k, n), all of a run is drawn if its first fragment is.
    """
    after = np.cumprod(1 - alpha, axis=1)
    before = shifted(after)
    live = before > stop
    if run is not None:
        row, column = np.nonzero(run >= 0)
        number = run[row, column]
        first = np.unique(number, return_index=True)[1]
        live[row, column] = live[row[first], column[first]][number]
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
