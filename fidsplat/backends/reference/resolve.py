"""Resolve stage: pixels from their samples."""

from __future__ import annotations

import math

import numpy as np

from fidsplat.backends.reference.optics import ray_lengths
from fidsplat.backends.reference.post import apply_sensor, max_value
from fidsplat.backends.view import View
from fidsplat.effects import FeatureSet

_ROUND = 1e-6  # relative rounding error of a sum of weights


def resolve(samples: dict[str, np.ndarray], view: View, features: FeatureSet) -> dict[str, np.ndarray]:
    """Images of pixels (k, ...) from their sample buffers (k, n * n, ...), which include grid positions `x`,
    `y`.

    The result includes error bounds, upper bounds of the error in float32: `error_bound` of alpha, and of rgb
    per unit of colour; `error_bound_depth`, `error_bound_distance` [m]; `error_bound_normal` of unit vectors;
    `label_may_flip` and so on (bool); `blended_bound` in splats.
    """
    t, bound = samples["t"].mean(1), samples["error_bound"]
    center_x, center_y = samples["x"].mean(1), samples["y"].mean(1)
    out = {"rgb": samples["rgb"].mean(1) + t[:, None] * view.background, "error_bound": bound.mean(1)}
    if "fogged" in samples:
        out["rgb"] += samples["fogged"].mean(1)[:, None] * view.background
    if features.post_steps or view.environment_map is not None:
        steps = tuple(step for step in features.post_steps if step != "fog")
        most = max(1.0, float(np.abs(out["rgb"]).max(initial=1.0)), float(np.abs(view.background).max()))
        unsure = out["error_bound"] * max(most, max_value(view.environment_map))
        if view.environment_map is not None:
            unsure = unsure + samples["behind_bound"].mean(1)
        columns, rows = (np.floor(center / view.samples).astype(int) for center in (center_x, center_y))
        out["rgb"], out["error_bound_rgb"] = apply_sensor(out["rgb"], unsure, steps, view, columns, rows)
    bound = samples.get("error_bound_middle", bound)  # the other outputs are from one sub-frame
    if "alpha" in features.names:
        out["alpha"] = 1 - t
    if "distortion" in features.names:
        out["distortion"] = samples["distortion"].mean(1)
    covered, unsure = samples["covered"], np.asarray(samples["covered_may_flip"].any(1))
    bound_covered = np.where(covered, bound, 0.0).sum(1)
    # length of the ray through each sample, per metre of depth
    length = ray_lengths(samples["x"], samples["y"], view)
    if "depth" in features.names:
        # rays of samples may differ in length
        for name, along in (("depth", 1.0), ("distance", length)):
            depth, off, weight = (
                np.where(covered, samples[key], 0.0) for key in ("depth", "depth_moved", "weight")
            )
            out[name] = _ratio((depth * along).sum(1), weight.sum(1), 0.0)
            # weight that may shift from the nearest to the furthest fragment, if the sum exceeds `minimum`
            spread = np.where(covered, samples["furthest"] * along, -math.inf).max(1)
            spread -= np.where(covered, samples["nearest"] * along, math.inf).min(1)
            moved = bound_covered * np.where(bound_covered > 0, np.maximum(spread, 0), 0)
            moved += (off * along).sum(1)
            minimum = weight.sum(1) - bound_covered
            out[f"error_bound_{name}"] = _where_covered(_ratio(moved, minimum, math.inf), covered, unsure)
    for name, along in (("depth_median", "distance_median"), ("depth_first", "distance_first")):
        if name in features.names:
            place = _median if name == "depth_median" else _nearest
            out[name], out[along] = place(samples[name]), place(samples[name] * length)
            out[f"{name}_may_flip"] = out[f"{along}_may_flip"] = samples[f"{name}_may_flip"].any(1)
    if "normal" in features.names:
        total = np.where(covered[..., None], samples["normal"], 0.0).sum(1)
        length = np.linalg.norm(total, axis=1)
        out["normal"] = total / np.where(length > 0, length, 1)[:, None]
        rotations = view.row_rotations[np.floor(center_y / view.samples).astype(int)]
        out["normal_world"] = np.einsum("ki,kij->kj", out["normal"], rotations)
        moved = 2 * bound_covered + _ROUND * (1 - samples["t"]).sum(1)
        moved += np.where(covered, samples["normal_moved"], 0.0).sum(1)
        out["error_bound_normal"] = _where_covered(
            _ratio(moved, length - bound_covered, math.inf), covered, unsure
        )
        out["error_bound_normal_world"] = out["error_bound_normal"]
    for name in sorted({"label", "splat_id"} & features.names):
        heaviest = np.argmax(samples["heaviest"], axis=1)
        weights = np.sort(samples["heaviest"], axis=1)
        out[name] = np.take_along_axis(samples[name], heaviest[:, None], 1)[:, 0].astype(np.int32)
        # rounding may break a tie between samples of equal weight
        close = (samples["heaviest"] >= weights[:, -1:] * (1 - 5e-5) - bound) & (
            samples[name] != out[name][:, None]
        )
        out[f"{name}_may_flip"] = samples[f"{name}_may_flip"].any(1) | (close & (weights[:, -1:] > 0)).any(1)
    if "blended" in features.names:
        out["blended"] = samples["blended"].max(1)
        out["blended_bound"] = samples["blended_bound"].max(1)
    return out


def _median(values: np.ndarray) -> np.ndarray:
    """Lower median (k,) of the positive values (k, n); 0 if there is none."""
    medians = np.sort(np.where(values > 0, values, math.inf), axis=1)
    hits = np.isfinite(medians).sum(1)
    middle = np.take_along_axis(medians, np.maximum((hits - 1) // 2, 0)[:, None], 1)[:, 0]
    return np.where(hits > 0, middle, 0.0)


def _nearest(values: np.ndarray) -> np.ndarray:
    """Smallest positive value (k,) of (k, n); 0 if there is none."""
    nearest = np.where(values > 0, values, math.inf).min(1)
    return np.where(np.isfinite(nearest), nearest, 0.0)


def _where_covered(bound: np.ndarray, covered: np.ndarray, unsure: np.ndarray) -> np.ndarray:
    """Error bound (k,) of an image that is 0 where no sample (k, n) is covered; infinite where `unsure`."""
    return np.where(unsure, math.inf, np.where(covered.any(1), bound, 0.0))


def _ratio(above: np.ndarray, below: np.ndarray, otherwise: float) -> np.ndarray:
    return np.where(below > 0, above / np.where(below > 0, below, 1), otherwise)
