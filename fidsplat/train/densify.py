"""Where splats are made and taken away: the rule of 3DGS and 2DGS (Kerbl et al. 2023, section 5.2), by the
mean gradient of a splat's place on the screen.

The order of splats that stay is kept and new ones stand behind them, so that a run gives the same file twice.
"""

from __future__ import annotations

import numpy as np

from fidsplat.rotations import quaternion_to_matrix
from fidsplat.train.parameters import Splats, TrainingError, logit
from fidsplat.train.random_numbers import Purpose, normal
from fidsplat.train.settings import TrainSettings

COPIES = 2
"""splats that one becomes when it is split"""
_SHRINK = 0.8 * COPIES
"""by which their scales are smaller"""


def densified(splats: Splats, settings: TrainSettings, iteration: int, extent: float) -> Splats:
    """The splats after a round of cloning, splitting and pruning.

    Args:
        extent: metres, of the scene: sizes are compared with it.

    Raises:
        TrainingError: no splat would be left.
    """
    mean = np.divide(
        splats.gradients, splats.seen, out=np.zeros_like(splats.gradients), where=splats.seen > 0
    )
    chosen = _within_limit(mean, mean >= settings.gradient_threshold, settings.max_splats - len(splats))
    large = splats.scales.max(axis=1) > settings.dense_share * extent
    clones, splits = np.flatnonzero(chosen & ~large), np.flatnonzero(chosen & large)
    more = {
        name: np.concatenate([array[clones], *[array[splits]] * COPIES])
        for name, array in splats.values.items()
    }
    _scatter(more, len(clones), splats, splits, settings, iteration)
    kept = np.ones(len(splats), bool)
    kept[splits] = False
    made = splats.chosen(kept).with_more(more)
    fit = made.opacities >= settings.prune_opacity
    if iteration > settings.reset_every:
        fit &= made.scales.max(axis=1) <= settings.prune_scale * extent
    if not fit.any():
        raise TrainingError(
            f"no splat is left after iteration {iteration}: all are fainter than {settings.prune_opacity:g} "
            f"or larger than {settings.prune_scale * extent:g} m; check the data set's cameras and points"
        )
    return forgotten(made.chosen(fit))


def with_opacities_reset(splats: Splats, settings: TrainSettings) -> Splats:
    """The splats with opacities of at most `reset_opacity`, so that only those that are needed come back."""
    splats.values["logits"] = np.minimum(splats.values["logits"], np.float32(logit(settings.reset_opacity)))
    for remembered in (splats.first, splats.second):
        remembered["logits"][:] = 0
    return splats


def forgotten(splats: Splats) -> Splats:
    """The splats with their sums of gradients begun anew."""
    splats.gradients[:] = 0
    splats.seen[:] = 0
    return splats


def _within_limit(mean: np.ndarray, wanted: np.ndarray, room: int) -> np.ndarray:
    """Of the wanted splats as many as there is room for, by their mean gradients, then by their indices."""
    rows = np.flatnonzero(wanted)
    if len(rows) > room:
        rows = rows[np.argsort(-mean[rows], kind="stable")[: max(0, room)]]
        wanted = np.zeros_like(wanted)
        wanted[rows] = True
    return wanted


def _scatter(
    more: dict[str, np.ndarray],
    first: int,
    splats: Splats,
    splits: np.ndarray,
    settings: TrainSettings,
    iteration: int,
) -> None:
    """Puts the copies of split splats, from row `first` on, at random places on these, and makes them
    smaller."""
    turns = quaternion_to_matrix(splats.values["quats"][splits])[:, :, :2]
    scales = splats.scales[splits].astype(np.float64)
    draws = normal(settings.seed, Purpose.SPLITS, iteration, len(splats))[splits]
    for copy in range(COPIES):
        rows = slice(first + copy * len(splits), first + (copy + 1) * len(splits))
        offset = scales * draws[:, 2 * copy : 2 * copy + 2]
        more["means"][rows] += np.einsum("nij,nj->ni", turns, offset).astype(np.float32)
        more["log_scales"][rows] -= np.float32(np.log(_SHRINK))
