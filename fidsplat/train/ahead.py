"""What a run will draw next: known before, so that it can be compiled meanwhile."""

from __future__ import annotations

from typing import NamedTuple

from fidsplat.capture.capture import Capture
from fidsplat.effects import FeatureSet, select
from fidsplat.effects.differentiable import with_distortion
from fidsplat.train.settings import TrainSettings


class _Disks(NamedTuple):
    """What of splats in training decides the kernels."""

    sh_degree: int
    has_coplanar_groups: bool = False
    footprint: str = "gaussian"
    ellipsoids: str = "none"


def features_after(
    settings: TrainSettings, iteration: int, plain: Capture, solid: Capture
) -> FeatureSet | None:
    """The features of the pictures when the degree has grown or another loss has begun, whichever is next in
    a run; None where neither will be.

    Args:
        plain: a capture of the loss of colours.
        solid: of that with normals.
    """
    change = settings.changes_after(iteration)
    if change is None:
        return None
    by_normals, by_distortions = settings.surface_weights_at(change)
    features = select(_Disks(settings.degree_at(change)), solid if by_normals else plain)
    return with_distortion(features) if by_distortions else features
