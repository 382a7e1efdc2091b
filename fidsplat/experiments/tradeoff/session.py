"""Measurement session: renderer, uploaded scenes, reference images, interleaved timing."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fidsplat.accuracy.error import reference_image, reference_renderer
from fidsplat.capture.capture import Capture
from fidsplat.capture.quality import MarkerQuality, Quality
from fidsplat.experiments.tradeoff.points import BASE
from fidsplat.experiments.tradeoff.scenes import TradeScene, Views, make_view
from fidsplat.render.frame import Frame
from fidsplat.render.renderer import Renderer
from fidsplat.render.resident import ResidentCloud
from fidsplat.util.timing import frame_timer, quartiles, ratios, time_interleaved

_SCENES, _REFERENCES = 12, 6
"""maximum number of cached scenes"""
DEFINITION = ("lowpass", "samples", "order")
"""settings that define the image; the others define its accuracy"""


class Session:
    """Scenes and reference images, made on request and cached.

    Reference images come from the renderer itself, or from OpenCL on the CPU if it cannot blend in float64.
    """

    def __init__(self, renderer: Renderer, own: Views | None = None) -> None:
        """own: views of the user's files, which ignore marker qualities."""
        self.renderer, self._precise = renderer, reference_renderer(renderer, Capture())
        self._own, self._uploaded = own or {}, {}
        self._make = lru_cache(_SCENES)(make_view)
        self.resident = lru_cache(_SCENES)(self._resident)
        """(view, marker quality) -> its splats on the device"""
        self._reference = lru_cache(_REFERENCES)(self._render_reference)

    def scene(self, view: str, marker: MarkerQuality) -> TradeScene:
        return self._own[view] if view in self._own else self._make(view, marker)

    def _resident(self, view: str, marker: MarkerQuality) -> ResidentCloud:
        cloud = self.scene(view, marker).cloud
        if view not in self._own:
            return self.renderer.upload(cloud)
        if id(cloud) not in self._uploaded:  # views of a file share their splats
            self._uploaded[id(cloud)] = self.renderer.upload(cloud)
        return self._uploaded[id(cloud)]

    def render(self, view: str, quality: Quality) -> Frame:
        """Frame of a view at a quality, without waiting for it."""
        capture = self.scene(view, quality.marker).capture
        return self.renderer.render(self.resident(view, quality.marker), capture, quality=quality)

    def reference(self, view: str, quality: Quality) -> np.ndarray:
        """Reference image (h, w, 3) float64: the same splats and image definition at full precision."""
        return self._reference(view, self.definition(view, quality))

    def _render_reference(self, view: str, definition: Quality) -> np.ndarray:
        scene, same_device = self.scene(view, definition.marker), self._precise is self.renderer
        splats = self.resident(view, definition.marker) if same_device else scene.cloud
        return reference_image(self._precise, splats, scene.capture.with_(quality=definition))

    def definition(self, view: str, quality: Quality) -> Quality:
        """Quality of the reference image: the baseline with the image definition of `quality`.

        3D Gaussians are projected exactly. Those of the user's scenes are projected as in `quality`, since
        trained splats depend on the projection of their trainer.
        """
        defined = {name: getattr(quality, name) for name in DEFINITION}
        ellipsoid = quality.ellipsoid if view in self._own else "exact"
        return BASE.with_(**defined, ellipsoid=ellipsoid, marker=quality.marker)


@dataclass(frozen=True)
class Effort:
    """Length of a measurement: pairs of frames for some seconds, within limits."""

    minimum: int = 5
    maximum: int = 30
    seconds: float = 0.3


FULL, QUICK = Effort(), Effort(3, 5, 0.2)
SLOW = 3.0
"""seconds of a frame above which a quick measurement has one round"""


def time_point(session: Session, view: str, quality: Quality, effort: Effort) -> tuple[Frame, dict]:
    """Render a view with a quality and with the base, interleaved; splats and images stay on the device.

    Returns the image, and `ms`, `base_ms` (medians), their quartiles, `ratio` (median of the pairs' ratios,
    and its quartiles), `repeats`, `splats`, `pairs`.
    """
    session.render(view, quality).wait()  # compiles
    begun = time.perf_counter()
    frame = session.render(view, quality).wait()
    slow = effort is QUICK and time.perf_counter() - begun > SLOW
    own, base = (
        frame_timer(
            session.renderer,
            session.resident(view, timed.marker),
            session.scene(view, timed.marker).capture,
            quality=timed,
        )
        for timed in (quality, BASE)
    )
    time_interleaved(
        [own, base],
        effort.maximum,
        min_rounds=1 if slow else effort.minimum,
        seconds=effort.seconds,
        warm_up=1,
    )
    result: dict = {"repeats": len(own.ms)}
    for name, values in (("ms", own.ms), ("base_ms", base.ms), ("ratio", ratios(own, base))):
        low, result[name], high = quartiles(values)
        result[f"{name.removesuffix('_ms')}_quartiles"] = [low, high]
    return frame, result | {name: frame.stats[name] for name in ("splats", "pairs")}
