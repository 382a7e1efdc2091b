"""Prediction of the kernels that a training run needs next, to compile them in the background."""

from __future__ import annotations

from typing import NamedTuple

from fidsplat.capture.capture import Capture
from fidsplat.effects import FeatureSet, select
from fidsplat.effects.differentiable import with_distortion
from fidsplat.train.settings import TrainSettings


class _Splats(NamedTuple):
    """Traits of splats in training, for `select`."""

    sh_degree: int
    ellipsoids: str
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"


def next_features(
    settings: TrainSettings, iteration: int, plain: Capture, solid: Capture
) -> FeatureSet | None:
    """Features of frames after the next change: a higher SH degree or another loss; None if no change
    follows.

    Args:
        plain: a capture for the colour loss.
        solid: a capture for the normal loss.
    """
    change = settings.changes_after(iteration)
    if change is None:
        return None
    by_normals, by_distortions = settings.surface_weights_at(change)
    splats = _Splats(settings.degree_at(change), "all" if settings.primitive == "3d" else "none")
    features = select(splats, solid if by_normals else plain)
    return with_distortion(features) if by_distortions else features
