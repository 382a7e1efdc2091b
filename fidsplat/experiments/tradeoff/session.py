"""What is open while points are measured: a renderer, the scenes on its device, their truths."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fidsplat.accuracy import full_precision, reference_for, truth
from fidsplat.capture import Capture
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.scenes import TradeScene, make
from fidsplat.quality import MarkerQuality, Quality
from fidsplat.render import Frame, Renderer, ResidentCloud

_SCENES, _TRUTHS = 12, 6
"""kept at a time"""
DEFINITION = ("lowpass", "samples", "order")
"""knobs that say what a picture is; the others say how well it is drawn"""


@dataclass(frozen=True, eq=False)
class OnDevice:
    """A scene whose splats lie on the device."""

    scene: TradeScene
    resident: ResidentCloud


class Session:
    """Scenes and truths are made when they are first asked for, and the last few are kept.

    Truths are drawn by the renderer itself, or by OpenCL on the processor where it cannot blend in float64.
    """

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self._reference = renderer, reference_for(renderer, Capture())
        self._scenes: OrderedDict[Hashable, OnDevice] = OrderedDict()
        self._truths: OrderedDict[Hashable, np.ndarray] = OrderedDict()

    def scene(self, view: str, knobs: MarkerQuality) -> OnDevice:
        """A picture's scene (`scenes.make`)."""

        def load() -> OnDevice:
            scene = make(view, knobs)
            return OnDevice(scene, self.renderer.upload(scene.cloud))

        return _kept(self._scenes, (view, knobs), load, _SCENES)

    def draw(self, view: str, quality: Quality) -> Frame:
        """The picture at a setting, not waited for."""
        on = self.scene(view, quality.marker)
        return self.renderer.render(
            on.resident, on.scene.camera, ("rgb",), quality, background=on.scene.background
        )

    def truth(self, view: str, quality: Quality) -> np.ndarray:
        """(h, w, 3) float64: the same splats by the same definition at full precision."""
        like = self.definition(view, quality)

        def draw() -> np.ndarray:
            on, reference = self.scene(view, quality.marker), self._reference
            what = on.resident if reference is self.renderer else on.scene.cloud
            capture = Capture(on.scene.camera, quality=like, background=on.scene.background)
            return truth(reference, what, capture)

        return _kept(self._truths, (view, like), draw, _TRUTHS)

    def definition(self, view: str, quality: Quality) -> Quality:
        """The base with what `quality` says of the definition."""
        asked = {name: getattr(quality, name) for name in DEFINITION}
        return BASE.with_(**asked, marker=quality.marker)

    def full(self, view: str, quality: Quality) -> Quality:
        """The setting at which `truth` is drawn."""
        like = Capture(quality=self.definition(view, quality))
        return full_precision(like, self._reference).quality


def _kept(cache: OrderedDict[Hashable, Any], key: Hashable, make: Callable[[], Any], most: int) -> Any:
    """A value of a cache, made if it is not there; the cache keeps the `most` that were asked for last."""
    if key not in cache:
        cache[key] = make()
        if len(cache) > most:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]
