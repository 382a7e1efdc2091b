"""Densification of 3DGS and 2DGS (Kerbl et al. 2023, section 5.2): clone, split and prune splats.

A splat with a large mean screen-space gradient is cloned or split. Other splats keep their order and new ones
are appended, so that a run is reproducible.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.train.parameters import Splats, TrainingError, logit, sigmoid
from fidsplat.train.random_numbers import RandomStream, normal
from fidsplat.train.settings import TrainSettings

COPIES = 2
"""number of splats that replace a split splat"""
_SHRINK = 0.8 * COPIES
"""divisor of the scales of split splats"""


class Densification(NamedTuple):
    """Result of one densification, with splats as indices into the earlier ones."""

    rows: np.ndarray
    """(m,) uint32: source of each splat: remaining splats in their order, then clones, then split copies"""
    remaining: int
    """number of remaining splats; Adam's moments of the others start at 0"""
    first_split: int
    """index of the first split copy; split copies have new means and scales"""
    means: np.ndarray
    """(m - first_split, 3) float32"""
    log_scales: np.ndarray
    """(m - first_split, 2) or (m - first_split, 3) float32"""

    def apply(self, splats: Splats) -> Splats:
        """The splats after densification."""
        densified = splats.select(self.rows)
        densified.values["means"][self.first_split :] = self.means
        densified.values["log_scales"][self.first_split :] = self.log_scales
        for moments in (densified.first, densified.second):
            for array in moments.values():
                array[self.remaining :] = 0
        return with_statistics_reset(densified)


def densification(
    splats: Splats, settings: TrainSettings, iteration: int, extent: float, keep: np.ndarray | bool = True
) -> Densification:
    """Choose the splats to clone, split and prune.

    Args:
        splats: the splats; harmonics and moments may be missing.
        extent: scene extent [m], the unit of size thresholds.
        keep: mask (n,): False prunes the splat, for example in front of a marker. Nearly transparent and too
            large splats are pruned in any case.

    Raises:
        TrainingError: no splat would remain.
    """
    mean = np.divide(
        splats.gradient_sums,
        splats.visible_counts,
        out=np.zeros_like(splats.gradient_sums),
        where=splats.visible_counts > 0,
    )
    chosen = _within_limit(mean, mean >= settings.gradient_threshold, settings.max_splats - len(splats))
    sizes = _largest_scales(splats.scales)
    large = sizes > settings.dense_fraction * extent
    clones, splits = np.flatnonzero(chosen & ~large), np.flatnonzero(chosen & large)
    unsplit = np.ones(len(splats), bool)
    unsplit[splits] = False
    means, log_scales = _split_values(splats, splits, settings, iteration)
    copies = np.concatenate([splits] * COPIES)
    unpruned = (sigmoid(splats.values["logits"]) >= settings.prune_opacity) & keep
    unpruned_copies = unpruned[copies]
    if iteration > settings.reset_every:
        limit = settings.prune_scale * extent
        unpruned &= sizes <= limit
        unpruned_copies &= _largest_scales(np.exp(log_scales)) <= limit
    remaining = np.flatnonzero(unsplit & unpruned)
    cloned, copies = clones[unpruned[clones]], copies[unpruned_copies]
    rows = np.concatenate([remaining, cloned, copies]).astype(np.uint32)
    if not len(rows):
        raise TrainingError(
            f"all splats were pruned after iteration {iteration}: their opacities are below "
            f"{settings.prune_opacity:g} or their scales above {settings.prune_scale * extent:g} m; check "
            "the data set's cameras and points"
        )
    first_split = len(remaining) + len(cloned)
    split_values = means[unpruned_copies], log_scales[unpruned_copies]
    return Densification(rows, len(remaining), first_split, *split_values)


def limited_logits(logits: np.ndarray, settings: TrainSettings) -> np.ndarray:
    """Logits clamped so that opacities are at most `reset_opacity`."""
    return np.minimum(logits, np.float32(logit(settings.reset_opacity)))


def with_statistics_reset(splats: Splats) -> Splats:
    """The splats with their densification statistics set to 0."""
    splats.gradient_sums[:] = 0
    splats.visible_counts[:] = 0
    return splats


def _largest_scales(scales: np.ndarray) -> np.ndarray:
    """Largest scale of each splat; max(axis=1) would take ten times as long."""
    return functools.reduce(np.maximum, scales.T)


def _within_limit(mean: np.ndarray, mask: np.ndarray, limit: int) -> np.ndarray:
    """The mask restricted to the `limit` splats with the largest mean gradients; ties: the smallest index."""
    rows = np.flatnonzero(mask)
    if len(rows) > limit:
        rows = rows[np.argsort(-mean[rows], kind="stable")[: max(0, limit)]]
        mask = np.zeros_like(mask)
        mask[rows] = True
    return mask


def _split_values(
    splats: Splats, splits: np.ndarray, settings: TrainSettings, iteration: int
) -> tuple[np.ndarray, np.ndarray]:
    """Means, sampled from each split splat, and reduced log_scales of the copies: all first copies, then all
    second ones."""
    values = {name: splats.values[name][splits] for name in ("means", "quats", "log_scales")}
    scales = np.exp(values["log_scales"]).astype(np.float64)
    axes = scales.shape[1]
    directions = quaternion_to_matrix(values["quats"])[:, :, :axes]
    calls = range(-(-COPIES * axes // 4))  # `normal` returns four numbers for each splat
    draws = np.hstack([normal(settings.seed, RandomStream.SPLITS, iteration, splits, call) for call in calls])
    means = np.concatenate([values["means"]] * COPIES)
    for copy in range(COPIES):
        offset = scales * draws[:, axes * copy : axes * (copy + 1)]
        shift = np.einsum("nij,nj->ni", directions, offset).astype(np.float32)
        means[copy * len(splits) : (copy + 1) * len(splits)] += shift
    log_scales = values["log_scales"] - np.float32(np.log(_SHRINK))
    return means, np.concatenate([log_scales] * COPIES)
