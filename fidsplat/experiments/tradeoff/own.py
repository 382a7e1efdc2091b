"""One's own scenes in the trade-off: splats from a file, seen from one's own cameras."""

from __future__ import annotations

from collections.abc import Mapping

from fidsplat.experiments.bench.catalogue import BenchScene
from fidsplat.experiments.tradeoff.scenes import TradeScene
from fidsplat.provenance import digest_of

Own = Mapping[str, TradeScene]
"""pictures by the names of their views"""


def own_pictures(views: Mapping[str, BenchScene]) -> dict[str, TradeScene]:
    """The pictures of `fidsplat bench`'s own scenes: splats alone, on black."""
    return {name: TradeScene(name, *view.make()) for name, view in views.items()}


def digests(own: Own) -> dict[str, str]:
    """16 hexadecimal digits of each picture's splats and camera, by its name: results are of these alone."""
    clouds = {id(scene.cloud): scene.cloud for scene in own.values()}
    splats = {number: digest_of(cloud) for number, cloud in clouds.items()}
    return {name: digest_of((splats[id(scene.cloud)], scene.camera)) for name, scene in own.items()}
