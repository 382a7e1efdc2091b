"""Pixels from their samples."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.backends.base import View
from fidsplat.effects import FeatureSet

_ROUND = 1e-6  # relative, of a sum of weights


def resolve(samples: dict[str, np.ndarray], view: View, features: FeatureSet) -> dict[str, np.ndarray]:
    """Planes of pixels (k, ...) from their samples (k, n * n, ...), and their certificates.

    `certificate`: colour per unit of colour, and alpha; `certificate_depth` metres; `certificate_normal`
    difference of unit vectors; `depth_median_may_flip`, `label_may_flip` bool.
    """
    t, doubt = samples["t"].mean(1), samples["certificate"]
    out = {"rgb": samples["rgb"].mean(1) + t[:, None] * np.asarray(view.background)}
    out["certificate"] = doubt.mean(1)
    doubt = samples.get("certificate_planes", doubt)  # the other planes show one shot
    if "alpha" in features.taps:
        out["alpha"] = 1 - t
    if "depth" in features.taps:
        weight = samples["weight"].sum(1)
        out["depth"] = _ratio(samples["depth"].sum(1), weight, 0.0)
        # light that moves from the nearest to the furthest fragment, in a mean over at least `least`
        spread = samples["furthest"].max(1) - samples["nearest"].min(1)
        moved = doubt.sum(1) * np.where(doubt.sum(1) > 0, np.maximum(spread, 0), 0)
        least = weight - doubt.sum(1)
        out["certificate_depth"] = _ratio(moved + samples["depth_moved"].sum(1), least, math.inf)
    if "depth_median" in features.taps:
        medians = np.sort(np.where(samples["depth_median"] > 0, samples["depth_median"], math.inf), axis=1)
        hits = np.isfinite(medians).sum(1)
        middle = np.take_along_axis(medians, np.maximum((hits - 1) // 2, 0)[:, None], 1)[:, 0]
        out["depth_median"] = np.where(hits > 0, middle, 0.0)
        out["depth_median_may_flip"] = samples["depth_median_may_flip"].any(1)
    if "normal" in features.taps:
        total = samples["normal"].sum(1)
        length = np.linalg.norm(total, axis=1)
        out["normal"] = total / np.where(length > 0, length, 1)[:, None]
        moved = 2 * doubt.sum(1) + _ROUND * (1 - samples["t"]).sum(1)
        out["certificate_normal"] = _ratio(moved, length - doubt.sum(1), math.inf)
    if "label" in features.taps:
        heaviest = np.argmax(samples["label_weight"], axis=1)
        weights = np.sort(samples["label_weight"], axis=1)
        out["label"] = np.take_along_axis(samples["label"], heaviest[:, None], 1)[:, 0].astype(np.int32)
        # of samples that weigh the same the first wins, by rounding
        close = (samples["label_weight"] >= weights[:, -1:] * (1 - 5e-5) - doubt) & (
            samples["label"] != out["label"][:, None]
        )
        out["label_may_flip"] = samples["label_may_flip"].any(1) | (close & (weights[:, -1:] > 0)).any(1)
    return out


def _ratio(above: np.ndarray, below: np.ndarray, otherwise: float) -> np.ndarray:
    return np.where(below > 0, above / np.where(below > 0, below, 1), otherwise)
