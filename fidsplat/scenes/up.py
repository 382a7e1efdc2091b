"""Estimated vertical of a scene."""

from __future__ import annotations

import numpy as np

from fidsplat.scenes.parts import SceneParts
from fidsplat.splats.cloud import SplatCloud
from fidsplat.splats.statistics import guess_up
from fidsplat.store.partial_cloud import PartialCloud, concatenated
from fidsplat.store.store import Store

CHUNKS = 32
"""maximum number of chunks of a store for the estimate of its vertical"""


def scene_up(scene: SceneParts) -> np.ndarray:
    """Estimated direction (3,) that points up in a scene, as printed by `fidsplat info`."""
    return guess_up(sampled(scene.stores[0] if scene.stores else scene.cloud())).direction


def sampled(cloud: SplatCloud | Store) -> SplatCloud:
    """The cloud, or evenly spaced chunks of a store."""
    if not isinstance(cloud, Store):
        return cloud
    chunks = np.flatnonzero(np.tile(cloud.nodes["level"] == 0, cloud.instances))
    if not len(chunks):
        return SplatCloud.empty()
    sample = chunks[np.linspace(0, len(chunks) - 1, min(len(chunks), CHUNKS)).astype(int)]
    return PartialCloud.of(concatenated([cloud.load(int(number)) for number in sample]), cloud)
