"""Where splats are made and taken away: the rule of 3DGS and 2DGS (Kerbl et al. 2023, section 5.2), by the
mean gradient of a splat's place on the screen.

The order of splats that stay is kept and new ones stand behind them, so that a run gives the same file twice.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fidsplat.splats.rotations import quaternion_to_matrix
from fidsplat.train.parameters import Splats, TrainingError, logit, sigmoid
from fidsplat.train.random_numbers import Purpose, normal
from fidsplat.train.settings import TrainSettings

COPIES = 2
"""splats that one becomes when it is split"""
_SHRINK = 0.8 * COPIES
"""by which their scales are smaller"""


class Plan(NamedTuple):
    """What a round of cloning, splitting and pruning makes of splats."""

    rows: np.ndarray
    """(m,) uint32: of which splat each is made; first those that stay, in their order"""
    kept: int
    """how many stay; of the others nothing is remembered"""
    moved: int
    """from this one on they are parts of splats that were split, which have places and scales of their own"""
    means: np.ndarray
    """(m - moved, 3) float32"""
    log_scales: np.ndarray
    """(m - moved, 2) float32"""

    def made(self, splats: Splats) -> Splats:
        """The splats after the round."""
        made = splats.chosen(self.rows)
        made.values["means"][self.moved :] = self.means
        made.values["log_scales"][self.moved :] = self.log_scales
        for remembered in (made.first, made.second):
            for array in remembered.values():
                array[self.kept :] = 0
        return forgotten(made)


def plan(splats: Splats, settings: TrainSettings, iteration: int, extent: float) -> Plan:
    """A round of cloning, splitting and pruning.

    Args:
        splats: their harmonics and what is remembered of them may be missing.
        extent: metres, of the scene: sizes are compared with it.

    Raises:
        TrainingError: no splat would be left.
    """
    mean = np.divide(
        splats.gradients, splats.seen, out=np.zeros_like(splats.gradients), where=splats.seen > 0
    )
    chosen = _within_limit(mean, mean >= settings.gradient_threshold, settings.max_splats - len(splats))
    sizes = _larger(splats.scales)
    large = sizes > settings.dense_share * extent
    clones, splits = np.flatnonzero(chosen & ~large), np.flatnonzero(chosen & large)
    kept = np.ones(len(splats), bool)
    kept[splits] = False
    means, log_scales = _parts(splats, splits, settings, iteration)
    parts = np.concatenate([splits] * COPIES)
    fit = sigmoid(splats.values["logits"]) >= settings.prune_opacity
    fit_parts = fit[parts]
    if iteration > settings.reset_every:
        most = settings.prune_scale * extent
        fit &= sizes <= most
        fit_parts &= _larger(np.exp(log_scales)) <= most
    stay, cloned, parts = np.flatnonzero(kept & fit), clones[fit[clones]], parts[fit_parts]
    rows = np.concatenate([stay, cloned, parts]).astype(np.uint32)
    if not len(rows):
        raise TrainingError(
            f"no splat is left after iteration {iteration}: all are fainter than {settings.prune_opacity:g} "
            f"or larger than {settings.prune_scale * extent:g} m; check the data set's cameras and points"
        )
    return Plan(rows, len(stay), len(stay) + len(cloned), means[fit_parts], log_scales[fit_parts])


def reset_logits(logits: np.ndarray, settings: TrainSettings) -> np.ndarray:
    """Logits of opacities of at most `reset_opacity`, so that only those that are needed come back."""
    return np.minimum(logits, np.float32(logit(settings.reset_opacity)))


def forgotten(splats: Splats) -> Splats:
    """The splats with their sums of gradients begun again."""
    splats.gradients[:] = 0
    splats.seen[:] = 0
    return splats


def _larger(scales: np.ndarray) -> np.ndarray:
    """Of each row of (n, 2): as max(axis=1), which takes NumPy ten times as long."""
    return np.maximum(scales[:, 0], scales[:, 1])


def _within_limit(mean: np.ndarray, wanted: np.ndarray, room: int) -> np.ndarray:
    """Of the wanted splats as many as there is room for, by their mean gradients, then by their indices."""
    rows = np.flatnonzero(wanted)
    if len(rows) > room:
        rows = rows[np.argsort(-mean[rows], kind="stable")[: max(0, room)]]
        wanted = np.zeros_like(wanted)
        wanted[rows] = True
    return wanted


def _parts(
    splats: Splats, splits: np.ndarray, settings: TrainSettings, iteration: int
) -> tuple[np.ndarray, np.ndarray]:
    """Means and log_scales of the copies of split splats, one of each and then another: at random places on
    these, and smaller."""
    values = {name: splats.values[name][splits] for name in ("means", "quats", "log_scales")}
    turns = quaternion_to_matrix(values["quats"])[:, :, :2]
    scales = np.exp(values["log_scales"]).astype(np.float64)
    draws = normal(settings.seed, Purpose.SPLITS, iteration, splits)
    means = np.concatenate([values["means"]] * COPIES)
    for copy in range(COPIES):
        offset = scales * draws[:, 2 * copy : 2 * copy + 2]
        moved = np.einsum("nij,nj->ni", turns, offset).astype(np.float32)
        means[copy * len(splits) : (copy + 1) * len(splits)] += moved
    log_scales = values["log_scales"] - np.float32(np.log(_SHRINK))
    return means, np.concatenate([log_scales] * COPIES)
